"""Parameters that a replay tries in place of the recorded ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

from pbonet.config import Library, parse_rmod
from pbonet.errors import UnknownTaskError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.log import Log
    from pbonet.pbo import Line

Params = Mapping[str, Mapping[str, object]]
"""Values by task and name of the parameter, as Python has them or in words."""


class _Words(NamedTuple):
    words: tuple[str, ...]
    place: str


class Trial:
    """Parameters that one task is given in place of the recorded ones.

    Args:
        values: By name; case does not matter.
    """

    def __init__(self, values: Mapping[str, object] | None = None) -> None:
        given = values or {}
        self._words = {name.lower(): _words(value) for name, value in given.items()}

    def has(self, name: str) -> bool:
        """Return whether a parameter is tried, so that a recorded `set` is ignored."""
        return name.lower() in self._words

    def over(self, task: str, recorded: Mapping[str, Line]) -> dict[str, Line]:
        """Return all parameters: those to try, and the recorded ones for the rest."""
        rest = {name: line for name, line in recorded.items() if not self.has(name)}
        tried = {
            name: _Words(words, f"{task}.{name}") for name, words in self._words.items()
        }
        return {**rest, **tried}

    def sentences(self, text: str, file: str) -> list[str]:
        """Return each parameter with its value and the one in the recorded RMOD."""
        lines = parse_rmod(text, file).settings.items()
        then = {name.lower(): " ".join(line.words) for name, line in lines}
        return [
            f"{name} {' '.join(words)}, recorded {then.get(name) or 'not set'}"
            for name, words in self._words.items()
        ]


def _words(value: object) -> tuple[str, ...]:
    if isinstance(value, str):
        return tuple(value.split())
    if isinstance(value, Iterable):  # a list, or an array of numpy
        return tuple(
            word for one in cast("Iterable[object]", value) for word in _words(one)
        )
    return (("no", "yes")[value] if isinstance(value, bool) else str(value),)


def params_to_try(
    log: Log,
    files: Iterable[Path],
    sets: Iterable[tuple[str, str, str]],
    tasks: Sequence[str] = (),
    libraries: Sequence[str | Path] = (),
) -> dict[str, dict[str, object]]:
    """Return parameters by task, for `rerun`.

    Args:
        log: Has the tasks.
        files: RMODs. Each is for the task of its name; if there is none, for the only
            one of `tasks`.
        sets: Task, parameter and value of each further one.
        tasks: Those that are named.
        libraries: Folders with parts of combinations.

    Raises:
        UnknownTaskError: A file is for none of the tasks.
        ConfigError: A file is wrong or missing.
    """
    found: dict[str, dict[str, object]] = {}
    for path in files:
        task = path.stem
        if task not in log.tasks:
            if len(tasks) != 1:
                raise UnknownTaskError(
                    f"the log has no task {task}",
                    where=str(path),
                    expected=f"the RMOD of one of {', '.join(log.tasks)}",
                    remedy="name the task for which it is tried, before the options",
                )
            (task,) = tasks
        lines = Library(libraries).read_rmod(path).settings
        values = {name.lower(): " ".join(line.words) for name, line in lines.items()}
        found.setdefault(task, {}).update(values)
    for task, name, value in sets:
        found.setdefault(task, {})[name.lower()] = value
    return found
