"""Conversion of times of one clock, which may drift, to those of another."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, NamedTuple

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy as np
    from numpy.typing import NDArray


class Moves(NamedTuple):
    """Nanoseconds to be added at some times; linearly interpolated between them.

    Before the first time and after the last one the value is constant.
    """

    at: tuple[int, ...]
    """Times of the clock to be converted, ascending."""
    add: tuple[int, ...]

    @classmethod
    def always(cls, add: int) -> Moves:
        """Return a conversion that adds the same at all times."""
        return cls((0,), (add,))

    @classmethod
    def through(cls, points: Iterable[tuple[int, int]]) -> Moves:
        """Return a conversion through (time, offset) points; the first of each time."""
        known: dict[int, int] = {}
        for at, add in points:
            known.setdefault(at, add)
        rising = sorted(known)
        return cls(tuple(rising), tuple(known[at] for at in rising))

    @classmethod
    def parse(cls, text: str) -> Moves:
        """Parse the result of `str`."""
        found = msgspec.json.decode(text, type=int | list[tuple[int, int]])
        return cls.always(found) if isinstance(found, int) else cls.through(found)

    def __str__(self) -> str:
        """Return it as JSON: one number, or pairs of time and number."""
        if not self.drifts:
            return str(self.add[0])
        return msgspec.json.encode(list(zip(self.at, self.add, strict=True))).decode()

    @property
    def drifts(self) -> bool:
        """Whether the offset is not the same at all times."""
        return len(set(self.add)) > 1

    def of(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the offsets at some times."""
        import numpy as np  # not in a recorder, which asks for single times

        if not self.drifts:
            return np.full(times.shape, self.add[0], np.int64)
        begin, base = self.at[0], self.add[0]
        at = np.array([one - begin for one in self.at], float)
        more = np.array([one - base for one in self.add], float)
        found = np.interp((times - begin).astype(float), at, more)
        added: NDArray[np.int64] = np.rint(found).astype(np.int64)
        added += base
        return added

    def one(self, time_ns: int) -> int:
        """Return the offset at a time."""
        if not self.drifts:
            return self.add[0]
        begin, base = self.at[0], self.add[0]
        after = bisect_right(self.at, time_ns)
        if not 0 < after < len(self.at):
            return self.add[max(after - 1, 0)]
        first, last = self.at[after - 1] - begin, self.at[after] - begin
        low, high = self.add[after - 1] - base, self.add[after] - base
        slope = (high - low) / (last - first)
        return round(slope * (time_ns - begin - first) + low) + base

    def then(self, more: Callable[[int], int], at: Iterable[int] = ()) -> Moves:
        """Return this conversion followed by another one.

        Args:
            more: Returns the second offset for a time converted by this.
            at: Times, converted by this, at which the second offset bends.
        """
        bends = {*self.at, *(one - self._before(one) for one in at)}
        points = [(one, self.one(one) + more(one + self.one(one))) for one in bends]
        return Moves.through(points)

    def _before(self, moved_ns: int) -> int:
        """Return the offset that led to a converted time; clocks drift slowly."""
        first = self.one(moved_ns - self.add[0])
        return self.one(moved_ns - first)

    def plus(self, add: int) -> Moves:
        """Return a conversion that adds this much more."""
        return Moves(self.at, tuple(one + add for one in self.add))
