"""Result of running a task's code again on recorded inputs."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from pbonet.log import text


class Divergence(Struct, kw_only=True):
    """The first place where the code gave something else than was recorded."""

    cycle: int
    """Of the task since it was spawned."""
    where: str
    """``cycle``, ``on``, ``off``, ``init`` or what else was run."""
    variable: str = ""
    element: int = 0
    recorded: Any = None
    computed: Any = None
    reason: str = ""
    """In words, where it is not about a value."""

    def __str__(self) -> str:
        """Return it in one sentence."""
        place = f"cycle {self.cycle}"
        if self.where != "cycle":
            place = f"{self.where}, after {place}"
        if self.reason:
            return f"{place}: {self.reason}"
        return (
            f"{place}: {self.variable}[{self.element}] is {self.computed!r}, "
            f"recorded {self.recorded!r}"
        )


class Changed(Struct, kw_only=True):
    """A file of the module's code, or one that it read, that is another one now."""

    path: str
    """Of the present file; of the recorded one when there is none."""
    recorded: str
    """SHA-256 of the recorded file; empty when there was none."""
    now: str
    """SHA-256 of the present one; empty when there is none."""
    lines: list[int] = []
    """Lines of the present file that are new or other."""

    def __str__(self) -> str:
        """Return it in one sentence."""
        if not self.now:
            return f"{self.path} is gone (recorded {self.recorded[:12]})"
        if not self.recorded:
            return f"{self.path} is new ({self.now[:12]})"
        lines = f", lines {ranges(self.lines)}" if self.lines else ""
        return (
            f"{self.path} has changed: {self.recorded[:12]} to {self.now[:12]}{lines}"
        )


class ChangedParam(Struct, kw_only=True):
    """A parameter with another value in the present `.rmod` file."""

    name: str
    path: str
    """Of the present file."""
    recorded: str
    """The value in the recorded file; empty: the module's default."""
    now: str
    """The value in the present one; empty: the module's default."""
    reason: str = ""
    """Why the present file cannot be read."""

    def __str__(self) -> str:
        """Return it in one sentence."""
        if self.reason:
            return (
                f"{self.path} cannot be read, its recorded text is used: {self.reason}"
            )
        return (
            f"{self.path} has changed: {self.name} is {self.now or 'not set'} there, "
            f"recorded and used {self.recorded or 'not set'}"
        )


class Verdict(Struct, kw_only=True):
    """The result for one task."""

    task: str
    cycles: int = 0
    """Cycles that gave the same."""
    recorded: int = 0
    """Cycles on record."""
    divergence: Divergence | None = None
    gaps: list[str] = []
    """Why some cycles could not be run again."""
    missing: bool = False
    """Whether records are missing: lost for lack of room, or damaged."""
    changed: list[Changed] = []
    params: list[ChangedParam] = []
    """Parameters whose recorded values were used, and have others in their file."""
    trial: bool = False
    """Whether parameters of some task are tried, so that values may differ."""
    tried: list[str] = []
    """Parameters that are tried in this task, with the recorded values."""
    seconds: float = 0.0
    """Of the run that were verified."""
    took: float = 0.0
    """Seconds that it took, once `init` had run."""
    loading: float = 0.0
    """Seconds until then: modules, and the packages that they import."""

    @property
    def differs(self) -> bool:
        """Whether the code gave something else; in a trial, whether it failed."""
        one = self.divergence
        return one is not None and bool(one.reason or not self.trial)

    @property
    def good(self) -> bool:
        """Whether every recorded cycle was run again and, but in a trial, the same."""
        if self.trial:
            return not (self.differs or self.gaps or self.missing)
        same = self.divergence is None and self.cycles == self.recorded
        return same and not self.missing

    def __str__(self) -> str:
        """Return it in a few lines."""
        speed = f", {self.seconds / self.took:.0f} x real time" if self.took else ""
        lines = [f"{self.task}: {self.cycles} cycles identical{speed}"]
        if self.cycles != self.recorded:
            lines[0] = (
                f"{self.task}: {self.cycles} of {self.recorded} cycles identical{speed}"
            )
        if self.divergence is not None:
            lines.append(f"  first divergence: {self.divergence}")
        lines += [f"  not verifiable: {why}" for why in self.gaps]
        lines += [f"  tried: {value}" for value in self.tried]
        lines += [f"  {one}" for one in (*self.changed, *self.params)]
        return "\n".join(lines)


class Replayed(Struct, kw_only=True):
    """The result for a whole configuration."""

    tasks: list[Verdict]
    """Of each; ``cycles`` are all that gave the same, after a divergence too."""
    first: str = ""
    """The task that was the first to give something else."""
    seconds: float = 0.0
    """From the first to the last record."""
    took: float = 0.0
    differences: list[dict[str, Any]] = []
    """Of each output its first and largest difference, where parameters are tried or a
    plot was wanted."""

    @property
    def good(self) -> bool:
        """Whether every task is good."""
        return all(one.good for one in self.tasks)

    def __str__(self) -> str:
        """Return it in a few lines."""
        speed = f", {self.seconds / self.took:.0f} x real time" if self.took else ""
        same = all(one.cycles == one.recorded for one in self.tasks)
        what = "identical" if same and self.good else "not all identical"
        count = len(self.tasks)
        tasks = "1 task" if count == 1 else f"{count} tasks together"
        lines = [f"{tasks}: {what}{speed}"]
        if self.first:
            lines.append(f"the first to differ is {self.first}")
        table = [text.diff_text(self.differences)] if self.differences else []
        return "\n".join([*lines, *map(str, self.tasks), *table])


def ranges(numbers: list[int]) -> str:
    """Return numbers as ``3-5, 9``."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(
        str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts
    )
