"""Set-up that every process of a node shares.

Process identities that survive the reuse of a process id, the parent-death signal, and
the environment that must be set before exec.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import site
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import signal

LINK_LEVEL = 2
"""Priority of the threads that carry records between machines; commands have 3."""
_SENDS = "tx-"
"""Prefix of the names of zenoh's sending threads."""
PR_SET_PDEATHSIG = 1
PR_SET_NAME = 15

_libc = ctypes.CDLL(None, use_errno=True)

EXEC_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    # Temporaries of 800 kB cost 360 page faults a cycle without these three. The pad is
    # populated in every task, so it is no larger than the temporaries of one cycle.
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "18446744073709551615",
    "MALLOC_TOP_PAD_": "8388608",
    "MALLOC_ARENA_MAX": "1",
    "PYTHONUNBUFFERED": "1",
}
"""Read by libraries when they are loaded, so it must be set before exec."""


def set_parent_death_signal(which: signal.Signals, parent: int) -> bool:
    """Request `which` when the parent ends; return whether the parent is `parent`."""
    _libc.prctl(PR_SET_PDEATHSIG, int(which), 0, 0, 0)
    return os.getppid() == parent


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


def start_time(pid: int) -> int:
    """Return when process `pid` started, in clock ticks since boot; 0 if it is gone.

    Together with the process id it is unique while the machine runs. A killed process
    holds its files and locks until the last of its threads has ended.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return 0
    fields = text.rpartition(")")[2].split()
    threads = int(fields[17])  # including the first one, even if it has ended
    gone = fields[0] == "X" or (fields[0] == "Z" and threads <= 1)
    return 0 if gone else int(fields[19])


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
