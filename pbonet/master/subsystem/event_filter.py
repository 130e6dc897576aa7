"""The selection of events that are wanted."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pbonet.errors import Severity, StateError, did_you_mean
from pbonet.xm.net import event_codes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pbonet.xm.net import messages as m


_UNITS: Final = {"s": 1, "m": 60, "h": 3600, "d": 86400}


def severity(word: str) -> Severity:
    """Return the severity of that name.

    Raises:
        StateError: There is none.
    """
    names = {one.name.lower(): one for one in Severity}
    if word.lower() not in names:
        raise StateError(
            f"there is no severity {word}",
            expected="one of " + " ".join(names),
            remedy=did_you_mean(word.lower(), names),
        )
    return names[word.lower()]


def since(word: int | str) -> tuple[int, float]:
    """Return the number of the first event wanted, and the earliest time of day.

    Args:
        word: A number, or how long ago: ``90s``, ``5m``, ``2h``, ``1d``.

    Returns:
        The number, 0 for any; and seconds since 1970, 0 for any.

    Raises:
        StateError: It is neither.
    """
    text = str(word)
    if text.isdecimal():
        return int(text), 0.0
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([smhd])", text)
    if found is None:
        raise StateError(
            "this is neither a number nor a time",
            expected="the number of an event, or a time such as 90s, 5m, 2h or 1d",
            got=text[:40],
            remedy="such as --since 5m; 'events' shows the numbers",
        )
    return 0, time.time() - float(found[1]) * _UNITS[found[2]]


class EventFilter(msgspec.Struct, frozen=True, kw_only=True):
    """Which events are wanted."""

    least: Severity = Severity.DEBUG
    code: str | None = None
    task: str | None = None
    after: float = 0.0
    """Seconds since 1970."""

    @staticmethod
    def of(given: Mapping[str, Any]) -> EventFilter:
        """Return what the arguments of `events` choose.

        Raises:
            StateError: There is no such severity.
        """
        return EventFilter(
            least=severity(given.get("severity") or "debug"),
            code=given.get("code"),
            task=given.get("task"),
            after=since(given.get("since") or 0)[1],
        )

    def __call__(self, event: m.Event) -> bool:
        """Return whether an event is wanted."""
        return (
            event.severity >= self.least
            and self.code in {None, event.code, str(event.errnum)}
            and self.task in {None, event.task}
            and event.wall >= self.after
        )

    def doubt(self, told: Iterable[m.Event]) -> str:
        """Return a warning of a code that no event can have; empty for none.

        Args:
            told: All events that there are; a node of another version may have told
                codes that are not known here.
        """
        if self.code is None or self.code.removeprefix("-").isdecimal():
            return ""
        known = event_codes.KNOWN.union(event.code for event in told)
        if self.code in known:
            return ""
        near = did_you_mean(self.code.upper(), sorted(known))
        what = f"no event has the code {self.code}"
        return f"{what}; {near or 'events without --code show theirs'}"
