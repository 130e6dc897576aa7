"""Completion of command lines in the shell, and the scripts for it.

The scripts run ``pbonet --complete SHELL WORD...``, of which the last word is the one
under the cursor. Where nothing is offered the shell completes names of files.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from . import verbs
from .parser import Parameter, UsageError, Verb

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Offer = tuple[str, str]
"""A word, and what it means."""

SCRIPTS: Final = {
    "bash": """\
_pbonet() {
    local IFS=$'\\n'
    COMPREPLY=($("${COMP_WORDS[0]}" --complete bash \\
        "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
}
complete -o default -F _pbonet pbonet
""",
    "zsh": """\
#compdef pbonet
_pbonet() {
    local -a found
    found=("${(@f)$(pbonet --complete zsh "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    if [[ -n "${found[1]}" ]]; then _describe pbonet found; else _files; fi
}
compdef _pbonet pbonet
""",
    "fish": """\
complete -c pbonet -n 'test (count (commandline -opc)) -lt 2' -f
complete -c pbonet -a '(
    pbonet --complete fish (commandline -opc)[2..] (commandline -ct)
)'
""",
}
_FORMS: Final = {"bash": "{0}", "zsh": "{0}:{1}", "fish": "{0}\t{1}"}
_TASK: Final = re.compile(r"^[ \t]*TASK[ \t]+([\w-]+)", re.MULTILINE)
_LIBRARY: Final = Path(__file__).parents[1] / "modules"


def lines(shell: str, words: Sequence[str]) -> Iterator[str]:
    """Yield what the shell is to offer for the last of `words`, one a line."""
    form = _FORMS[shell]
    *before, last = words or [""]
    for word, about in offers(before, last):
        if word.startswith(last):
            name = word.replace(":", "\\:") if shell == "zsh" else word
            yield form.format(name, about.partition("\n")[0])


def offers(before: list[str], last: str) -> Iterator[Offer]:
    """Yield what may stand behind the words `before`."""
    if not before:
        yield from ((name, verbs.summary(name)) for name in verbs.NAMES)
        return
    try:
        found, rest = verbs.find(before)
    except UsageError:
        return
    if not isinstance(found, Verb):
        yield from ((name, one.summary) for name, one in found.verbs.items())
        return
    awaited, places = _place(found, rest)
    if awaited is not None:
        yield from _words(awaited, rest)
        return
    if places and not last.startswith("-"):
        yield from _words(places[0], rest)
        return
    for one in found.options:
        yield from ((name, one.help) for name in one.all_names)


def _place(verb: Verb, words: list[str]) -> tuple[Parameter | None, list[Parameter]]:
    """Return the option whose value comes next, and the arguments still to come."""
    options = {name: one for one in verb.options for name in one.all_names}
    places = verb.arguments
    awaited: Parameter | None = None
    for word in words:
        if awaited is not None:
            awaited = None
        elif word.startswith("-"):
            one = options.get(word)
            awaited = one if one and not one.is_switch else None
        elif places and not places[0].many:
            places = places[1:]
    return awaited, places


def _words(one: Parameter, before: list[str]) -> Iterator[Offer]:
    """Yield the words that a parameter may be, as far as they are known here."""
    yield from ((word, "") for word in one.choices)
    find = _FINDERS.get(one.stands_for)
    if find is not None:
        file = next((word for word in before if not word.startswith("-")), "")
        yield from sorted(dict(find(Path(file))).items())


def _jobs(file: Path) -> Iterator[Offer]:
    yield from ((path.stem, str(path)) for path in file.parent.glob("*.job"))


def _rmods(file: Path) -> Iterator[Offer]:
    for folder in (_LIBRARY, file.parent):
        yield from ((path.stem, str(path)) for path in folder.glob("*.rmod"))


def _tasks(file: Path) -> Iterator[Offer]:
    """Yield the tasks of all jobs beside a subsystem's file."""
    for path in file.parent.glob("*.job"):
        yield from ((name, str(path)) for name in _TASK.findall(path.read_text()))


_FINDERS: Final = {"task": _tasks, "rmod": _rmods, "job": _jobs}
"""Where the words of a kind are found: without agents, in files."""


def install(shell: str) -> list[Path]:
    """Write the script of a shell, have new shells read it, and return what changed."""
    home = Path.home()
    if shell == "fish":
        config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
        script, start, line = config / "fish" / "completions" / "pbonet.fish", None, ""
    elif shell == "zsh":
        script, start = home / ".zfunc" / "_pbonet", home / ".zshrc"
        line = f"fpath+=({script.parent}); autoload -Uz compinit; compinit"
    else:
        script, start = home / ".bash_completions" / "pbonet.sh", home / ".bashrc"
        line = f"source {script}"
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(SCRIPTS[shell])
    if start is None:
        return [script]
    before = start.read_text() if start.exists() else ""
    if line not in before.splitlines():
        gap = "" if before.endswith("\n") or not before else "\n"
        start.write_text(f"{before}{gap}{line}\n")
    return [script, start]
