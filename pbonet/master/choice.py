"""Which events are wanted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.errors import Severity, StateError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pbonet.xm import messages as m


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


class Choice(msgspec.Struct, frozen=True, kw_only=True):
    """Which events are wanted."""

    least: Severity = Severity.DEBUG
    code: str | None = None
    task: str | None = None

    @staticmethod
    def of(given: Mapping[str, Any]) -> Choice:
        """Return what the arguments of `events` choose.

        Raises:
            StateError: There is no such severity.
        """
        return Choice(
            least=severity(given.get("severity") or "debug"),
            code=given.get("code"),
            task=given.get("task"),
        )

    def __call__(self, event: m.Event) -> bool:
        """Tell whether an event is wanted."""
        return (
            event.severity >= self.least
            and self.code in {None, event.code, str(event.errnum or "")}
            and self.task in {None, event.task}
        )
