"""A common time for logs of several machines, from their agents' measurements.

Each agent asks the others every second for their identity, and records the offsets of
their clocks from its own, with the uncertainty. So times of one machine are converted
to times of the first file's machine, by the chain of measurements with the least error.
"""

from __future__ import annotations

import heapq
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from .time_conversion import Moves

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from .part import Part

TOPIC: Final = "/clocks/"
SAME: Final = "one clock"
MEASURED: Final = "measured"
UNKNOWN: Final = "not measured"
_SET_ANEW: Final = 1_000_000
_WINDOW: Final = 10 * 10**9
"""Nanoseconds for which one offset is used if clocks drift measurably."""
_MOST: Final = 500
"""Maximum number of offsets of one clock; a longer run has longer windows."""


class Apart(NamedTuple):
    """The offset between two clocks."""

    moves: Moves
    """Offset from times of the one clock to those of the other."""
    within_ns: int
    """The uncertainty of the offset."""


class Clock(NamedTuple):
    """Conversion of a file's times to those of the first file."""

    rtpu: str
    host: str
    how: str
    """`SAME`, `MEASURED` or `UNKNOWN`; with the last, wall clocks are used."""
    moves: Moves
    """Offset from CLOCK_MONOTONIC of its machine to nanoseconds since 1970
    by the first file's clock."""
    own_ns: int
    """Offset that the file itself adds."""
    within_ns: int
    """The uncertainty of the offset; 0 if unknown."""

    @property
    def epoch_ns(self) -> int:
        """The offset at the beginning."""
        return self.moves.add[0]

    @property
    def shift_ns(self) -> int:
        """The offset at the beginning for message times in the file."""
        return self.moves.add[0] - self.own_ns

    def shifts(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the offsets for message times in the file, both in nanoseconds."""
        return self.moves.of(times - self.own_ns) - self.own_ns

    def shift(self, time_ns: int) -> int:
        """Return the offset for one message time."""
        return self.moves.one(time_ns - self.own_ns) - self.own_ns

    def moved(self, told: str | None) -> Moves:
        """Return the offsets for CLOCK_MONOTONIC times of a task.

        Args:
            told: The offset given in its channel, in a merged file.
        """
        if told is None:
            return self.moves
        bends = [at + self.own_ns for at in self.moves.at] if self.moves.drifts else []
        return Moves.parse(told).then(self.shift, bends)

    def __str__(self) -> str:
        """Return a sentence about it."""
        whose = f"{self.rtpu} on {self.host or '?'}"
        if self.how == MEASURED:
            moved = f"{self.shift_ns * 1e-9:+.6f} s"
            if self.moves.drifts:
                last = (self.moves.add[-1] - self.own_ns) * 1e-9
                moved += f" at the beginning and {last:+.6f} s at the end"
            return (
                f"{whose}: its times are shifted by {moved}, measured within "
                f"{self.within_ns * 1e-6:.3f} ms"
            )
        if self.how == UNKNOWN:
            return (
                f"{whose}: its clock was not measured; its times are by its own wall "
                "clock, and their order relative to others is uncertain"
            )
        return f"{whose}: the common clock, shifted by {self.shift_ns * 1e-9:+.6f} s"

    def plain(self) -> dict[str, Any]:
        """Return it as data."""
        return {
            "rtpu": self.rtpu,
            "host": self.host,
            "how": self.how,
            "epoch_ns": self.epoch_ns,
            "shift_ns": self.shift_ns,
            "drift_ns": self.moves.add[-1] - self.moves.add[0],
            "within_ns": self.within_ns,
            "matters": self.matters,
            "text": str(self),
        }

    @property
    def matters(self) -> bool:
        """Whether users should be informed: another machine's clock, or one reset."""
        return self.how != SAME or abs(self.shift_ns) > _SET_ANEW


class _Seen(NamedTuple):
    """One measurement."""

    at_ns: int
    """The machine whose clock the offset refers to."""
    offset_ns: int
    within_ns: int


def common(parts: Sequence[Part]) -> list[Clock]:
    """Return the conversion of each file's times to those of the first."""
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
        return Clock("?", "", SAME, Moves.always(0), 0, 0)  # of another program, or cut
    own = about.epoch_ns
    apart = known.get(about.machine)
    if apart is None or part is first:
        how = SAME if part is first else UNKNOWN
        return Clock(about.rtpu, about.host, how, Moves.always(own), own, 0)
    moves = apart.moves.plus(base.epoch_ns)
    how = SAME if about.machine == base.machine else MEASURED
    return Clock(about.rtpu, about.host, how, moves, own, apart.within_ns)


def _measured(parts: Sequence[Part]) -> dict[str, dict[str, Apart]]:
    """Return the offsets of clocks, by machine and by the other machine."""
    seen: dict[tuple[str, str], list[_Seen]] = {}
    for at, one in _messages(parts):
        for other in one["others"]:
            offset, within = other["offset_ns"], other["within_ns"]
            pair = one["machine"], other["machine"]
            seen.setdefault(pair, []).append(_Seen(at, offset, within))
            back = seen.setdefault((pair[1], pair[0]), [])
            back.append(_Seen(at + offset, -offset, within))
    found: dict[str, dict[str, Apart]] = {}
    for (mine, other), each in seen.items():
        found.setdefault(mine, {})[other] = _over_time(each)
    return found


def _over_time(each: Sequence[_Seen]) -> Apart:
    """Return one offset for all times if all measurements allow it, else several."""
    if _agree(each):
        value, within = _of_all(each)
        return Apart(Moves.always(value), within)
    ordered = sorted(each)
    begin = ordered[0].at_ns
    window = max(_WINDOW, (ordered[-1].at_ns - begin) // _MOST + 1)
    points: list[tuple[int, int]] = []
    worst = 0
    for _, group in groupby(ordered, lambda one: (one.at_ns - begin) // window):
        inside = list(group)
        value, within = _of_all(inside)
        points.append(((inside[0].at_ns + inside[-1].at_ns) // 2, value))
        worst = max(worst, within)
    return Apart(Moves.through(points), worst)


def _agree(each: Sequence[_Seen]) -> bool:
    """Return whether one offset is within the bounds of all measurements."""
    low = max(one.offset_ns - one.within_ns for one in each)
    return low <= min(one.offset_ns + one.within_ns for one in each)


def _of_all(each: Sequence[_Seen]) -> tuple[int, int]:
    """Return one offset for several measurements, and its largest error."""
    low = min(one.offset_ns - one.within_ns for one in each)
    high = max(one.offset_ns + one.within_ns for one in each)
    return (low + high) // 2, (high - low + 1) // 2


def _messages(parts: Sequence[Part]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield measurements, each with its time by the measuring machine's clock."""
    for part in parts:
        for key, channel in part.channels.items():
            if channel.encoding == "json" and TOPIC in channel.topic:
                rows, own = part.rows(key), part.about.epoch_ns if part.about else 0
                for time_ns, data in zip(rows.times.tolist(), rows.all(), strict=True):
                    yield time_ns - own, msgspec.json.decode(data)


def _chains(pairs: dict[str, dict[str, Apart]], first: str) -> dict[str, Apart]:
    """Return each machine's offsets from one, by the chains with the least error."""
    found: dict[str, Apart] = {}
    waiting = [(0, first, Moves.always(0))]
    while waiting:
        within, machine, moves = heapq.heappop(waiting)
        if machine in found:
            continue
        found[machine] = Apart(moves, within)
        for other in pairs.get(machine, {}):
            apart = pairs[other][machine]
            bends = moves.at if moves.drifts else ()
            whole = apart.moves.then(moves.one, bends)
            heapq.heappush(waiting, (within + apart.within_ns, other, whole))
    return found
