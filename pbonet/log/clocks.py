"""One time for logs of several machines, by what their agents measured.

Each agent asks the others every second who they are, and puts on record how far their
clocks are from its own, and how sure that is. So times of one machine become times of
the first file's machine, by the surest chain of measurements.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from .part import Part

TOPIC: Final = "/clocks/"
SAME: Final = "one clock"
MEASURED: Final = "measured"
UNKNOWN: Final = "not measured"
_SET_ANEW: Final = 1_000_000


class Apart(NamedTuple):
    """By how much one clock is ahead of another, in nanoseconds."""

    offset_ns: int
    within_ns: int
    """How wrong that may be."""


class Clock(NamedTuple):
    """What brings a file's times to those of the first file."""

    rtpu: str
    host: str
    how: str
    """`SAME`, `MEASURED` or `UNKNOWN`; the wall clocks are believed then."""
    epoch_ns: int
    """What is added to CLOCK_MONOTONIC of its machine."""
    shift_ns: int
    """What is added to the times that its messages have in the file."""
    within_ns: int
    """How wrong that may be; 0 where it is not known."""

    def __str__(self) -> str:
        """Return it as a sentence."""
        whose = f"{self.rtpu} on {self.host or '?'}"
        if self.how == MEASURED:
            return (
                f"{whose}: its times are moved by {self.shift_ns * 1e-9:+.6f} s, as "
                f"was measured within {self.within_ns * 1e-6:.3f} ms"
            )
        if self.how == UNKNOWN:
            return (
                f"{whose}: nobody measured its clock; its times are by its own wall "
                "clock, and their order among others is not sure"
            )
        return f"{whose}: the clock of all, moved by {self.shift_ns * 1e-9:+.6f} s"

    @property
    def matters(self) -> bool:
        """Whether people should know: it is another machine's, or was set anew."""
        return self.how != SAME or abs(self.shift_ns) > _SET_ANEW


def common(parts: Sequence[Part]) -> list[Clock]:
    """Return what brings each file's times to those of the first."""
    if not parts:
        return []
    first = parts[0].about
    machines = {part.about.machine for part in parts if part.about}
    known: dict[str, Apart] = {}
    if first is not None:
        known = _chains(_measured(parts) if len(machines) > 1 else {}, first.machine)
    return [_clock(part, parts[0], known) for part in parts]


def _clock(part: Part, first: Part, known: dict[str, Apart]) -> Clock:
    about, base = part.about, first.about
    if about is None or base is None:
        return Clock("?", "", SAME, 0, 0, 0)  # of another program, or cut at once
    apart = known.get(about.machine)
    if apart is None or part is first:
        how = SAME if part is first else UNKNOWN
        return Clock(about.rtpu, about.host, how, about.epoch_ns, 0, 0)
    epoch = base.epoch_ns - apart.offset_ns
    how = SAME if about.machine == base.machine else MEASURED
    shift = epoch - about.epoch_ns
    return Clock(about.rtpu, about.host, how, epoch, shift, apart.within_ns)


def _measured(parts: Sequence[Part]) -> dict[str, dict[str, Apart]]:
    """Return by how much clocks are ahead of others: theirs by machine, by machine."""
    seen: dict[tuple[str, str], list[Apart]] = {}
    for one in _messages(parts):
        for other in one["others"]:
            offset, within = other["offset_ns"], other["within_ns"]
            pair = one["machine"], other["machine"]
            seen.setdefault(pair, []).append(Apart(offset, within))
            back = seen.setdefault((pair[1], pair[0]), [])
            back.append(Apart(-offset, within))
    found: dict[str, dict[str, Apart]] = {}
    for (mine, other), each in seen.items():
        found.setdefault(mine, {})[other] = _of_all(each)
    return found


def _of_all(each: Sequence[Apart]) -> Apart:
    """Return one value for the whole time: clocks drift, which makes it less sure."""
    low = min(one.offset_ns - one.within_ns for one in each)
    high = max(one.offset_ns + one.within_ns for one in each)
    return Apart((low + high) // 2, (high - low + 1) // 2)


def _messages(parts: Sequence[Part]) -> Iterator[dict[str, Any]]:
    for part in parts:
        for key, channel in part.channels.items():
            if channel.encoding == "json" and TOPIC in channel.topic:
                for data in part.rows(key).all():
                    yield msgspec.json.decode(data)


def _chains(pairs: dict[str, dict[str, Apart]], first: str) -> dict[str, Apart]:
    """Return how far each machine's clock is ahead of one, by the surest chain."""
    found: dict[str, Apart] = {}
    waiting = [(0, first, 0)]
    while waiting:
        within, machine, offset = heapq.heappop(waiting)
        if machine in found:
            continue
        found[machine] = Apart(offset, within)
        for other, apart in pairs.get(machine, {}).items():
            step = (within + apart.within_ns, other, offset + apart.offset_ns)
            heapq.heappush(waiting, step)
    return found
