"""Files that are other ones than those of the recording: code, parameters, data."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.config import Library, parse_rmod
from pbonet.errors import PbonetError
from pbonet.io import find_file
from pbonet.log import code_of
from pbonet.node.task import files_of
from pbonet.outside import sha256_of

from ._records import files_of_life
from ._verdict import Changed, ChangedParam

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import Rmod
    from pbonet.log import CodeFile, Log, TaskAbout, TaskLife

    from ._verdict import Verdict


def note_changes(
    verdict: Verdict, log: Log, libraries: Sequence[str | Path] = ()
) -> None:
    """Note in a verdict what has changed in the task's files since the recording."""
    about = log.task_about(verdict.task)
    verdict.changed = changed(log, about, libraries)
    verdict.changed += changed_data(log.lives(verdict.task)[-1], libraries)
    verdict.params = changed_params(about, libraries)


def changed(
    log: Log, about: TaskAbout, libraries: Sequence[str | Path] = ()
) -> list[Changed]:
    """Return the files of a task's code that have changed.

    The code that a replay runs counts, wherever it is: the folders of the recording may
    be those of another machine.

    Args:
        log: Carries the files that ran.
        about: Of the task.
        libraries: Folders of modules, searched before those of the recording.
    """
    present = {one.path: one for one in _present(about, libraries)}
    found: list[Changed] = []
    for then in about.code:
        now = _same(then.path, present)
        if now is None:
            found.append(Changed(path=then.path, recorded=then.sha256, now=""))
            continue
        del present[now.path]
        if now.sha256 != then.sha256:
            found.append(
                Changed(
                    path=now.path,
                    recorded=then.sha256,
                    now=now.sha256,
                    lines=_lines(log, then, now),
                )
            )
    new = present.values() if about.code else ()
    return found + [Changed(path=one.path, recorded="", now=one.sha256) for one in new]


def changed_data(life: TaskLife, libraries: Sequence[str | Path] = ()) -> list[Changed]:
    """Return the files that a module read in `init`, and that have changed.

    The present file is found as the module finds it when it is run again.

    Args:
        life: Of the task.
        libraries: Folders that are searched before those of the recording.
    """
    found: list[Changed] = []
    for then in dict.fromkeys(files_of_life(life)):
        path, now = then.path, ""
        with contextlib.suppress(PbonetError):
            present = find_file(then.name, [*libraries, *life.about.libraries])
            path, now = str(present), sha256_of(present)
        if now != then.sha256:
            found.append(Changed(path=path, recorded=then.sha256, now=now))
    return found


def changed_params(
    about: TaskAbout, libraries: Sequence[str | Path] = ()
) -> list[ChangedParam]:
    """Return the parameters of a task whose values in its `.rmod` file have changed.

    A replay uses the recorded values, so that it could not show the change.

    Args:
        about: Of the task.
        libraries: Folders that are searched for the file before its recorded place.
    """
    recorded = Path(about.rmod_name)
    places = [Path(folder, recorded.name) for folder in libraries]
    if recorded.is_absolute():
        places.append(recorded)
    path = next(filter(Path.is_file, places), None)
    if path is None or not about.rmod:
        return []
    try:
        present = Library([*libraries, *about.libraries]).read_rmod(path)
    except PbonetError as error:
        why = str(error)
        return [ChangedParam(name="", path=str(path), recorded="", now="", reason=why)]
    then = _values(parse_rmod(about.rmod, about.rmod_name))
    now = _values(present)
    return [
        ChangedParam(
            name=name,
            path=str(path),
            recorded=" ".join(then.get(name, ())),
            now=" ".join(now.get(name, ())),
        )
        for name in dict.fromkeys([*then, *now])
        if not _same_value(then.get(name), now.get(name))
    ]


def _values(rmod: Rmod) -> dict[str, tuple[str, ...]]:
    return {name.lower(): line.words for name, line in rmod.settings.items()}


def _same_value(a: tuple[str, ...] | None, b: tuple[str, ...] | None) -> bool:
    """Return whether two values are the same, however their numbers are written."""
    if a is None or b is None or a == b:
        return a == b
    try:
        return [float(word) for word in a] == [float(word) for word in b]
    except ValueError:
        return False


def _present(about: TaskAbout, libraries: Sequence[str | Path]) -> list[CodeFile]:
    """Return the files that a replay runs; where it cannot, those of the recording."""
    try:
        rmod = parse_rmod(about.rmod, about.rmod_name)
        return code_of(files_of(rmod, Library([*libraries, *about.libraries])))
    except PbonetError:  # the replay itself will say it
        return code_of(one.path for one in about.code)


def _same(path: str, present: dict[str, CodeFile]) -> CodeFile | None:
    """Return the file for a recorded one: of its name, and nearest."""
    if path in present:
        return present[path]
    name = Path(path).name
    each = [one for one in present.values() if Path(one.path).name == name]
    return max(each, key=lambda one: _common_end(path, one.path), default=None)


def _common_end(a: str, b: str) -> int:
    """Return how many of their last folders two paths have in common."""
    pairs = zip(reversed(Path(a).parts), reversed(Path(b).parts), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _lines(log: Log, then: CodeFile, now: CodeFile) -> list[int]:
    """Return which lines are new or other; none where the log lacks the file.

    A module in C has no lines: what is recorded is the shared object.
    """
    if not now.path.endswith(".py"):
        return []
    for one in log.attached.values():
        if hashlib.sha256(one.data).hexdigest() == then.sha256:
            return _other_lines(one.data, Path(now.path).read_bytes())
    return []


def _other_lines(before: bytes, now: bytes) -> list[int]:
    """Return the numbers of lines of `now` that are not those of `before`."""
    old = before.decode(errors="replace").splitlines()
    new = now.decode(errors="replace").splitlines()
    found: list[int] = []
    for tag, _, _, first, last in difflib.SequenceMatcher(
        None, old, new, autojunk=False
    ).get_opcodes():
        if tag != "equal":
            found += range(first + 1, max(last, first + 1) + 1)
    return sorted(set(found))
