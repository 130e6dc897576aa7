"""Set-up that every process of a node shares.

Process identities that survive the reuse of a process id, the parent-death signal, and
the environment that must be set before exec.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import site
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

LINK_LEVEL = 5
"""Priority of the threads that carry records between machines; commands have 3."""
MARK = "PBONET_RTPU_PROCESS"
"""Names, in the environment, the RTPU process that a process descends from. Processes
that it forks have it too, as ``/proc/PID/environ`` shows that of the last exec."""
_SENDS = "tx-"
"""Prefix of the names of zenoh's sending threads."""
PR_SET_PDEATHSIG = 1
PR_SET_NAME = 15
PR_SET_CHILD_SUBREAPER = 36

_libc = ctypes.CDLL(None, use_errno=True)

_OWN_CHILDREN = Path("/proc/thread-self/children")
"""The kernel's list, which it has if it was made with CONFIG_PROC_CHILDREN."""
_LONGEST_STAT = 4096
"""Bytes of ``/proc/PID/stat``, which the kernel gives in one piece."""
CONTINUE_PERIOD = 0.2
"""Seconds between signals that continue a process whose parent has ended."""
SLOW_CONTINUE_PERIOD = 1.0
"""The same for a process whose parent may still live, and continues it sooner."""
EXEC_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    # Temporaries of 800 kB cost 360 page faults a cycle without these two. The third is
    # what a task's heap grows by beyond what it needs, and is populated in every task.
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "18446744073709551615",
    "MALLOC_TOP_PAD_": "1048576",
    "MALLOC_ARENA_MAX": "1",
    "PYTHONUNBUFFERED": "1",
}
"""Read by libraries when they are loaded, so it must be set before exec."""


def set_parent_death_signal(which: signal.Signals, parent: int = 0) -> bool:
    """Request `which` when the parent ends; return whether the parent is `parent`."""
    _libc.prctl(PR_SET_PDEATHSIG, int(which), 0, 0, 0)
    return os.getppid() == parent


def on_end_of_parent(
    parent: int, call: Callable[[], None] | None = None, *, always: bool = False
) -> bool:
    """Call a function once when the parent ends; return whether it is the parent.

    The kernel sends SIGCONT then, as a stopped process would not see another signal,
    and from then on every 0.2 s: it may be stopped again, and often no process is left
    that could continue it. A signal that stops the process takes back a SIGCONT that it
    has not seen yet. So with `always` it comes every second before that, too.
    """
    seen = False
    timer: ctypes.c_void_p | None = None

    def on_continue(*_: object) -> None:
        nonlocal seen
        if os.getppid() == parent or seen:
            return
        seen = True
        with contextlib.suppress(OSError):  # then it ends unless it is stopped again
            _continue_every(CONTINUE_PERIOD, timer)
        if call is not None:
            call()

    signal.signal(signal.SIGCONT, on_continue)
    if always:
        with contextlib.suppress(OSError):
            timer = _continue_every(SLOW_CONTINUE_PERIOD)
    return set_parent_death_signal(signal.SIGCONT, parent)


def _continue_every(
    period: float, timer: ctypes.c_void_p | None = None
) -> ctypes.c_void_p:
    """Have the kernel send SIGCONT to this process again and again.

    Args:
        period: Seconds between two signals.
        timer: The kernel's timer for it; a new one is made if there is none.

    Raises:
        OSError: The kernel gives no timer.
    """
    if timer is None:
        timer = ctypes.c_void_p()
        event = (ctypes.c_int * 16)()  # struct sigevent: value, number, SIGEV_SIGNAL
        number = ctypes.sizeof(ctypes.c_void_p) // ctypes.sizeof(ctypes.c_int)
        event[number] = int(signal.SIGCONT)
        if _libc.timer_create(
            time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)
        ):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    seconds, ns = divmod(round(period * 1e9), 1_000_000_000)
    times = (ctypes.c_long * 4)(seconds, ns, seconds, ns)
    if _libc.timer_settime(timer, 0, ctypes.byref(times), None):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return timer


def adopt_descendants() -> None:
    """Become the parent of descendants whose own parent ends, in place of init."""
    _libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def set_title(title: str) -> None:
    """Set the name that ``ps -o comm`` and ``top`` show, at most 15 bytes."""
    _libc.prctl(PR_SET_NAME, ctypes.c_char_p(title.encode()[:15]), 0, 0, 0)


def go_before_others() -> bool:
    """Give the calling thread the priority of links, below all tasks and commands.

    Its children do not inherit it.

    Returns:
        Whether this process is allowed to.
    """
    level = os.sched_param(LINK_LEVEL)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, level)
        return True
    return False


def send_before_others() -> None:
    """Give zenoh's sending threads that priority, too, if this process may do so.

    They belong to the session, and only their names identify them.
    """
    level = os.sched_param(LINK_LEVEL)
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            if (task / "comm").read_text().startswith(_SENDS):
                how = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(int(task.name), how, level)


def settle_memory() -> None:
    """Keep the garbage collector out of cycles: collect once, then turn it off."""
    gc.collect()
    gc.freeze()
    gc.disable()


class ProcessStat(NamedTuple):
    """A process as ``/proc/PID/stat`` describes it."""

    state: str
    """``R``, ``S``, ``T`` (stopped), ``Z`` (ended) and others."""
    parent: int
    session: int
    ticks: int
    """CPU time used, in clock ticks."""
    threads: int
    """Including the first one, even if it has ended."""
    started: int
    """Clock ticks since boot."""


def stat(pid: int) -> ProcessStat | None:
    """Return the state of process `pid`; None if there is none."""
    try:
        fd = os.open(f"/proc/{pid}/stat", os.O_RDONLY | os.O_CLOEXEC)
        try:
            text = os.read(fd, _LONGEST_STAT)
        finally:
            os.close(fd)
    except OSError:
        return None
    one = text.rpartition(b")")[2].split()
    return ProcessStat(
        state=one[0].decode(),
        parent=int(one[1]),
        session=int(one[3]),
        ticks=int(one[11]) + int(one[12]),
        threads=int(one[17]),
        started=int(one[19]),
    )


def resume(pid: int) -> bool:
    """Continue a process that a signal has stopped; return whether it was stopped.

    One that a debugger holds is left alone.
    """
    if not _may_be_stopped(pid):
        return False
    found = stat(pid)
    if found is None or found.state != "T":
        return False
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)
    return True


def _may_be_stopped(pid: int) -> bool:
    """Return False if `pid` is a child that was not stopped: cheaper than `stat`."""
    try:
        flags = os.WSTOPPED | os.WNOHANG | os.WNOWAIT
        return os.waitid(os.P_PID, pid, flags) is not None
    except ChildProcessError:
        return True


def start_time(pid: int) -> int:
    """Return when process `pid` started, in clock ticks since boot; 0 if it is gone.

    Together with the process id it is unique while the machine runs. A killed process
    holds its files and locks until the last of its threads has ended.
    """
    found = stat(pid)
    if found is None or found.state == "X":
        return 0
    gone = found.state == "Z" and found.threads <= 1
    return 0 if gone else found.started


class Idle:
    """Measures for how long a process has done nothing.

    Args:
        pid: The process.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._ticks = -1
        self._since = time.monotonic()

    def seconds(self) -> float:
        """Return the seconds since it last ran, or waited for a core or a disk."""
        now, found = time.monotonic(), stat(self._pid)
        if found is not None and (found.ticks != self._ticks or found.state in "RD"):
            self._ticks, self._since = found.ticks, now
        return now - self._since


def children(pid: int) -> list[int]:
    """Return the children of process `pid`, ended ones too."""
    return [one for one in _processes() if (s := stat(one)) and s.parent == pid]


def own_children() -> list[int]:
    """Return the children of this process, which has one thread; ended ones too.

    Where the kernel lists them, this does not read the state of all processes. The list
    is exact, because only this thread, which reads it, can reap one of them.
    """
    try:
        listed = _OWN_CHILDREN.read_text(encoding="ascii")
    except OSError:
        return children(os.getpid())
    return [int(one) for one in listed.split()]


def listed_children(pid: int) -> list[int]:
    """Return the children of a process; none if the kernel has no such list.

    Reads a few files, where `children` reads those of all processes.
    """
    found: list[int] = []
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += map(int, thread.read_text(encoding="ascii").split())
        except OSError:  # the thread has ended
            continue
    return found


def descendants(pid: int, most: int) -> int:
    """Return how many processes descend from `pid`; far above `most` it may be less."""
    count, parents = 0, [pid]
    while parents and count <= most:
        found = listed_children(parents.pop())
        count += len(found)
        parents += found
    return count


def mark() -> str:
    """Return the mark of the RTPU process that this process is or descends from."""
    return os.environ.get(MARK, "")


def end_marked(mark: str) -> int:
    """Kill what an RTPU process and its tasks have started and left.

    Args:
        mark: The value of `MARK` in its environment; empty: nothing is killed.

    Returns:
        How many processes were killed; never this one.
    """
    wanted = f"{MARK}={mark}".encode()
    count = 0
    for pid in _processes() if mark else ():
        if pid == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if wanted in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                os.kill(pid, signal.SIGKILL)
                count += 1
    return count


def has_in_environment(pid: int, variable: str) -> bool:
    """Return whether a process that lives was started with an environment variable."""
    with contextlib.suppress(OSError):
        all_of_it = Path(f"/proc/{pid}/environ").read_bytes()
        return b"\0" + variable.encode() + b"=" in b"\0" + all_of_it
    return False


def _processes() -> list[int]:
    return [int(one.name) for one in Path("/proc").iterdir() if one.name.isdecimal()]


def is_alive(pid: int, started: int) -> bool:
    """Return whether the process with id `pid`, started at `started`, still runs."""
    return started != 0 and start_time(pid) == started


def environment() -> dict[str, str]:
    """Return the environment for a process that will host tasks."""
    env = {**os.environ, **EXEC_ENVIRONMENT}
    package = str(Path(__file__).resolve().parents[3])
    if package not in site.getsitepackages():
        env["PYTHONPATH"] = os.pathsep.join(
            filter(None, [package, os.environ.get("PYTHONPATH", "")])
        )
    return env


def housekeeping_cores(core: int) -> set[int]:
    """Return the cores for work that is not real-time: all but `core`.

    If this process may use only the RTPU's core, that core is returned.
    """
    allowed = os.sched_getaffinity(0)
    return (allowed - {core}) or allowed
