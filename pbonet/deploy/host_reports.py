"""Reports of machines: their steps, what was done, what failed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec import Struct, structs

from .steps import Shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pbonet.errors import PbonetError

    from .steps import State, Step

_MARKS: Final = {
    "same": "ok",
    "change": "CHANGE",
    "changed": "changed",
    "waits": "WAITS",
    "failed": "FAILED",
}


class Report(Struct, kw_only=True):
    """One machine."""

    host: str
    steps: list[Shown] = []
    error: str = ""
    """Why it failed, with what to do; empty: it did not."""
    warnings: list[str] = []

    def record(self, steps: Iterable[Step]) -> None:
        """Take steps over as they are now."""
        self.steps = [
            Shown(name=s.name, state=s.state, what=s.what, diff=s.diff) for s in steps
        ]

    def add(self, name: str, state: State, what: str) -> None:
        """Add a step that has no actions of its own."""
        self.steps.append(Shown(name=name, state=state, what=what))

    def take(self, later: Report) -> None:
        """Take over what became of the first steps, and an error."""
        self.steps[: len(later.steps)] = later.steps
        self.error = later.error

    def failed(self, error: PbonetError) -> None:
        """Take an error over."""
        self.error = str(error)

    def settle(self) -> None:
        """Say of what was to change that it has, or that it failed."""
        state: State = "failed" if self.state == "failed" else "changed"
        self.steps = [
            structs.replace(s, state=state) if s.state == "change" else s
            for s in self.steps
        ]

    @property
    def state(self) -> str:
        """``failed``, ``changed``, ``change``, ``waits`` or ``same``."""
        if self.error:
            return "failed"
        states = {one.state for one in self.steps}
        order = ("failed", "changed", "change", "waits")
        return next((one for one in order if one in states), "same")


def data(reports: Iterable[Report]) -> list[dict[str, object]]:
    """Return reports as data."""
    return [
        {
            "host": one.host,
            "state": one.state,
            "steps": one.steps,
            "warnings": one.warnings,
            "error": one.error,
        }
        for one in reports
    ]


def text(reports: Iterable[Report], *, planned: bool = False) -> str:
    """Return reports as text.

    Args:
        reports: The machines.
        planned: Whether nothing was done; the last line then says how it is.
    """
    reports = list(reports)
    lines = [line for one in reports for line in (*_lines(one), "")]
    if planned and any(s.state == "change" for one in reports for s in one.steps):
        lines.append("Nothing was done. Do it with --apply.")
    return "\n".join(lines).rstrip()


def _lines(one: Report) -> Iterator[str]:
    yield f"{one.host}: {_summary(one)}"
    for step in one.steps:
        yield f"  {_MARKS[step.state]:8}{step.name}: {step.what}"
        yield from (f"            {line}" for line in step.diff.splitlines())
    for warning in one.warnings:
        yield f"  WARN    {warning}"
    if one.error:
        yield f"  FAILED  {one.error}"


def _summary(one: Report) -> str:
    count = sum(step.state == one.state for step in one.steps)
    match one.state:
        case "same":
            return "all is as it should be"
        case "failed":
            return "FAILED"
        case "waits":
            return "all else is as it should be"
        case "changed":
            return f"{count} changed"
        case _:
            return f"{count} to change"


def status(reports: Iterable[Report]) -> int:
    """Return the exit status: 1 if a machine has failed."""
    return int(any(one.state == "failed" for one in reports))
