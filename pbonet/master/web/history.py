"""The latest minute of values, and the last events, for browsers that come late."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

SECONDS: Final = 60.0
"""How long values are kept."""
EVENTS: Final = 1000
"""How many events are kept."""
_MOST: Final = 2400
"""Samples of one variable."""

Sample = dict[str, Any]
"""One value with its time ``t`` and its numbers ``v``."""


class History:
    """The latest values and events of a subsystem."""

    def __init__(self) -> None:
        self._values: dict[str, deque[tuple[float, list[float]]]] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)

    def add_values(self, values: dict[str, Sample]) -> None:
        """Keep new values by variable."""
        for name, sample in values.items():
            kept = self._values.setdefault(name, deque(maxlen=_MOST))
            at = sample["t"]
            if kept and at <= kept[-1][0]:
                continue
            kept.append((at, sample["v"]))
            while kept[0][0] < at - SECONDS:
                kept.popleft()

    def add_events(self, events: Iterable[dict[str, Any]]) -> None:
        """Keep new events."""
        self._events.extend(events)

    def values(self, names: Iterable[str]) -> dict[str, dict[str, list[Any]]]:
        """Return the values of variables: times ``t``, and numbers ``v`` of each."""
        found: dict[str, dict[str, list[Any]]] = {}
        for name in names:
            kept = list(self._values.get(name, ()))
            if kept:
                found[name] = {"t": [t for t, _ in kept], "v": [v for _, v in kept]}
        return found

    @property
    def events(self) -> list[dict[str, Any]]:
        """The events, the oldest first."""
        return list(self._events)
