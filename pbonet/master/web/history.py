"""The latest minute of values, and the last events, for browsers that come late."""

from __future__ import annotations

from array import array
from collections import deque
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

SECONDS: Final = 60.0
"""How long values are kept."""
EVENTS: Final = 1000
"""How many events are kept."""
_MOST: Final = 2400
"""Samples of one variable, at most."""
_NUMBERS: Final = 100_000
"""Numbers of all its samples; a larger variable has fewer of them."""
_TOLD: Final = 200_000
"""Numbers in one message; of many variables at once there are fewer samples of each."""
_CLOCK: Final = 1.0
"""Seconds by which a sample may be older than the one before; more: a clock was set."""

Sample = dict[str, Any]
"""One value with its time ``t`` and its numbers ``v``."""


class History:
    """The latest values and events of a subsystem."""

    def __init__(self) -> None:
        self._values: dict[str, deque[tuple[float, array[float]]]] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)

    def add_values(self, values: dict[str, Sample]) -> None:
        """Keep new values by variable."""
        for name, sample in values.items():
            at, numbers = sample["t"], array("d", sample["v"])
            most = min(_MOST, max(1, _NUMBERS // max(1, len(numbers))))
            kept = self._values.setdefault(name, deque(maxlen=most))
            if kept and kept[-1][0] - _CLOCK < at <= kept[-1][0]:
                continue
            while kept and kept[-1][0] >= at:
                kept.pop()
            kept.append((at, numbers))
            while kept[0][0] < at - SECONDS:
                kept.popleft()

    def add_events(self, events: Iterable[dict[str, Any]]) -> None:
        """Keep new events."""
        self._events.extend(events)

    def values(self, names: Iterable[str]) -> dict[str, dict[str, list[Any]]]:
        """Return the values of variables: times ``t``, and numbers ``v`` of each."""
        found: dict[str, dict[str, list[Any]]] = {}
        all_ = {name: list(self._values.get(name, ())) for name in names}
        total = sum(len(kept) * len(kept[0][1]) for kept in all_.values() if kept)
        step = -(-total // _TOLD) or 1
        for name, whole in all_.items():
            kept = whole[::-step][::-1]  # the newest one always
            if kept:
                times, numbers = zip(*kept, strict=True)
                found[name] = {"t": list(times), "v": [one.tolist() for one in numbers]}
        return found

    @property
    def events(self) -> list[dict[str, Any]]:
        """The events, the oldest first."""
        return list(self._events)
