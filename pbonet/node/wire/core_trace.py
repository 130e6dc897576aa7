"""Follows which thread has a core, by the kernel's own event ``sched_switch``.

The event is on only while something follows it, for one core and in a buffer of its
own (an *instance* of tracefs), so that no other tracing is touched. It needs root,
or a tracefs that this user may write.

Who follows keeps a file of the instance open: as long as it is, the kernel refuses to
remove the instance, and closes it when the process ends, however it ends.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from pbonet.errors import RealTimeError
from pbonet.xm.net import CoreTrace, CoreUse

from .core_times import CoreTimes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from pbonet.analysis.schedule import CoreStatus, SlotStatus

PLACES: Final = (Path("/sys/kernel/tracing"), Path("/sys/kernel/debug/tracing"))
"""Folders at which tracefs is mounted."""
BUFFER_KB: Final = 4096
"""Size of the buffer: about 60,000 changes of the core's thread."""
SHORTEST: Final = 0.001
LONGEST: Final = 0.02
"""Seconds between two readings of the task: half its period, within these."""
_SWITCH: Final = re.compile(
    r" (?P<at>\d+\.\d+): sched_switch: prev_comm=(?P<comm>.*) prev_pid=(?P<pid>\d+) "
    r"prev_prio=-?\d+ prev_state=\S+ ==> next_comm=.* next_pid=(?P<to>\d+) "
)


class Switch(NamedTuple):
    """A change of the thread that has a core."""

    at: float
    """Seconds of CLOCK_MONOTONIC."""
    before: int
    """The thread that had it; 0: nothing ran."""
    after: int
    name: str
    """The kernel's name of the thread before."""


class Window(NamedTuple):
    """Releases of a task that it missed."""

    missed: int
    begin_ns: int
    """The last release with a cycle before them, CLOCK_MONOTONIC."""
    end_ns: int
    """The next release after them, or when they were seen if that was before."""


class SwitchTrace:
    """The changes of a core's thread, from `start` to `stop`.

    Args:
        core: Its number.
        places: Where tracefs may be.
    """

    def __init__(self, core: int, places: Sequence[Path] = PLACES) -> None:
        self._core, self._places = core, places
        self._folder: Path | None = None
        self._held: int | None = None

    def start(self) -> None:
        """Begin to follow.

        Raises:
            RealTimeError: The kernel does not let this process.
        """
        root = next((one for one in self._places if _may_be(one)), None)
        if root is None:
            raise _not_followed(self._places[0], "no tracefs is mounted there")
        sweep([root])
        folder = root / "instances" / f"pbonet-{os.getpid()}"
        try:
            folder.mkdir()
            self._folder = folder
            self._held = os.open(folder / "tracing_on", os.O_RDONLY)
            self._write(f"per_cpu/cpu{self._core}/buffer_size_kb", str(BUFFER_KB))
            self._write("trace_clock", "mono")
            self._write("tracing_cpumask", _mask(self._core))
            self._write("events/sched/sched_switch/enable", "1")
        except OSError as error:
            self.close()
            raise _not_followed(folder, error.strerror or str(error)) from None

    def stop(self) -> list[Switch]:
        """Follow no longer; return the changes, the oldest first."""
        if self._folder is None:
            return []
        try:
            self._write("tracing_on", "0")
            text = self._folder / f"per_cpu/cpu{self._core}/trace"
            return [*switches(text.read_text(encoding="utf-8", errors="replace"))]
        except OSError:
            return []
        finally:
            self.close()

    def close(self) -> None:
        """Have the kernel follow nothing for this process. Idempotent."""
        held, self._held = self._held, None
        if held is not None:
            os.close(held)
        folder, self._folder = self._folder, None
        if folder is not None:
            _removed(folder)

    def _write(self, name: str, text: str) -> None:
        assert self._folder is not None  # noqa: S101 - its callers have one
        (self._folder / name).write_text(text, encoding="ascii")


def sweep(places: Sequence[Path] = PLACES) -> list[str]:
    """Have the kernel follow nothing for processes that were killed.

    Returns:
        The instances that were removed.
    """
    done: list[str] = []
    for root in places:
        with contextlib.suppress(PermissionError):  # then nothing there is ours
            found = [*root.glob("instances/pbonet-*")]
            done += [one.name for one in found if _removed(one)]
    return done


def _may_be(root: Path) -> bool:
    """Return whether tracefs is there, also if only root may look."""
    try:
        return (root / "instances").is_dir()
    except PermissionError:
        return True


def _removed(folder: Path) -> bool:
    """Remove an instance, which turns its events off; False: it is held."""
    try:
        folder.rmdir()
    except OSError:
        return False
    return True


def _mask(core: int) -> str:
    """Return the mask of one core: words of 32 bits in hexadecimal, lowest last."""
    words = [0] * (core // 32) + [1 << core % 32]
    return ",".join(f"{word:08x}" for word in reversed(words))


def _not_followed(where: Path, why: str) -> RealTimeError:
    return RealTimeError(
        "the kernel's sched_switch cannot be followed",
        where=str(where),
        got=why,
        remedy="run the agent as root on a machine with tracefs (mount -t tracefs none "
        "/sys/kernel/tracing), or read the kernel's counts",
    )


def switches(text: str) -> Iterator[Switch]:
    """Yield the changes in a text of tracefs."""
    for line in text.split("\n"):
        if (found := _SWITCH.search(line)) is not None:
            # Any user may give a thread any name, also codes for a terminal.
            name = "".join(c if c.isprintable() else "?" for c in found["comm"])
            yield Switch(float(found["at"]), int(found["pid"]), int(found["to"]), name)


def uses(changes: Sequence[Switch], begin: float, end: float) -> dict[int, float]:
    """Return the threads that had a core in an interval, each with its seconds.

    Args:
        changes: The changes of the core, the oldest first.
        begin: Seconds of CLOCK_MONOTONIC.
        end: Likewise.
    """
    found: dict[int, float] = {}
    since = begin
    last: int | None = None
    for one in changes:
        if one.at <= begin:
            last = one.after
            continue
        until = min(one.at, end)
        if until > since:
            found[one.before] = found.get(one.before, 0.0) + until - since
        since, last = max(since, until), one.after
        if one.at >= end:
            return found
    if last is not None and end > since:
        found[last] = found.get(last, 0.0) + end - since
    return found


def _missed(slot: SlotStatus) -> int:
    """Return the releases without a cycle; one that failed was no such."""
    return slot.missed - slot.failed


def first_miss(look: Callable[[], SlotStatus], seconds: float) -> Window | None:
    """Wait until a task misses a release; None: it missed none in so many seconds.

    Args:
        look: Returns the task's entry in the core table.
        seconds: The longest wait.
    """
    before = look()
    period_ns = before.period_ns
    pause = min(max(period_ns * 0.5e-9, SHORTEST), LONGEST)
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        time.sleep(pause)
        now = look()
        missed = _missed(now) - _missed(before)
        if now.on_ns == before.on_ns and missed > 0:
            released = round((now.release_ns - before.release_ns) / period_ns)
            # With no more releases than misses, the misses came after the last one.
            last = now if released <= missed else before
            end = min(now.now_ns, now.release_ns + (missed + 1) * period_ns)
            return Window(missed, last.release_ns, end)
        before = now
    return None


def follow(
    task: str,
    core: Callable[[], CoreStatus],
    look: Callable[[], SlotStatus],
    *,
    names: Mapping[int, str],
    seconds: float,
    places: Sequence[Path] = PLACES,
) -> CoreTrace:
    """Return who had a core when a task missed a release.

    Args:
        task: The task.
        core: Returns the dispatcher's entry in the core table.
        look: Returns the task's.
        names: What processes are, by their numbers.
        seconds: How long a missed release is waited for.
        places: Where tracefs may be.
    """
    first = core()
    times, trace = CoreTimes(first.core), SwitchTrace(first.core, places)
    times.read(first.leader_pid, first.leader_tid)
    fault = ""
    try:
        trace.start()
    except RealTimeError as error:
        fault = str(error)
    begun = time.monotonic()
    try:
        window = first_miss(look, seconds)
        traced = time.monotonic() - begun
        changes = trace.stop() if window is not None else []
    finally:
        trace.close()
    found = CoreTrace(
        task=task,
        core=first.core,
        traced=traced,
        times=times.read(first.leader_pid, first.leader_tid),
        fault=fault,
    )
    if window is None:
        return found
    begin, end = window.begin_ns * 1e-9, window.end_ns * 1e-9
    names = {first.leader_tid: "the dispatcher", **names}
    called = {one.before: one.name for one in changes}
    had = sorted(uses(changes, begin, end).items(), key=lambda one: -one[1])
    found.missed = window.missed
    found.wall = time.time() - time.monotonic() + begin
    found.window = end - begin
    found.uses = [
        CoreUse(
            pid=pid,
            name=names.get(pid) or called.get(pid, ""),
            known=pid in names,
            seconds=used,
        )
        for pid, used in had
    ]
    return found
