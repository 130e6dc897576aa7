"""Completion of command lines in the shell, and the scripts for it.

The scripts run ``pbonet --complete SHELL WORD...``, of which the last word is the one
under the cursor. Where nothing is offered the shell completes names of files.
"""

from __future__ import annotations

import os
import re
import shlex
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
if [[ "${funcstack[1]}" == _pbonet ]]; then
    _pbonet "$@"  # zsh has loaded this file to complete a line
else
    (( ${+functions[compdef]} )) || { autoload -Uz compinit && compinit; }
    compdef _pbonet pbonet
fi
""",
    "fish": """\
complete -c pbonet -f -a '(
    set -l found (pbonet --complete fish (commandline -opc)[2..] (commandline -ct))
    if set -q found[1]
        printf "%s\\n" $found
    else
        __fish_complete_path (commandline -ct)
    end
)'
""",
}
_FORMS: Final = {"bash": "{0}", "zsh": "{0}:{1}", "fish": "{0}\t{1}"}
_LIBRARY: Final = Path(__file__).parents[1] / "modules"
_HELP: Final = ("--help", "Show this help.")


def lines(shell: str, words: Sequence[str]) -> Iterator[str]:
    """Yield what the shell is to offer for the last of `words`, one a line."""
    form = _FORMS[shell]
    if shell == "bash":  # which makes a word of each =
        words = [word for word in words if word != "="] + [""] * (words[-1:] == ["="])
    *before, last = words or [""]
    for word, about in offers(before, last):
        if word.startswith(last):
            name = word.replace(":", "\\:") if shell == "zsh" else word
            yield form.format(name, about.partition("\n")[0])


def offers(before: list[str], last: str) -> Iterator[Offer]:
    """Yield the words that may follow the words `before` in place of `last`."""
    if not before:
        yield from ((name, verbs.summary(name)) for name in verbs.NAMES)
        yield from [_HELP, ("--version", "Show the version.")] * last.startswith("-")
        return
    try:
        found, rest = verbs.find(before)
    except UsageError:
        return
    if not isinstance(found, Verb):
        yield from ((name, one.summary) for name, one in found.verbs.items())
        yield from [_HELP] * last.startswith("-")
        return
    awaited, places, file = _place(found, rest)
    name, equals, value = last.partition("=")
    if equals and awaited is None:
        for one in found.options:
            if name in one.all_names:
                yield from ((f"{name}={w}", to) for w, to in _words(one, file, value))
    elif awaited is not None:
        yield from _words(awaited, file, last)
    elif places and not last.startswith("-"):
        yield from _words(places[0], file, last)
    else:
        yield from ((name, one.help) for one in found.options for name in one.all_names)
        yield _HELP


def _place(
    verb: Verb, words: list[str]
) -> tuple[Parameter | None, list[Parameter], Path]:
    """Return the option that awaits a value, the arguments left, and the file."""
    options = {name: one for one in verb.options for name in one.all_names}
    places = verb.arguments
    awaited: Parameter | None = None
    missing, file = 0, ""
    for word in words:
        if awaited is not None:
            missing -= 1
            awaited = awaited if missing else None
        elif word.startswith("-"):
            one = options.get(word)
            awaited = one if one and not one.is_switch else None
            missing = one.words if one else 0
        else:
            file = file or word
            places = places if not places or places[0].many else places[1:]
    return awaited, places, Path(file)


def _words(one: Parameter, file: Path, last: str) -> Iterator[Offer]:
    """Yield the words that a parameter may be, as far as they are known here."""
    yield from ((word, "") for word in one.choices)
    kind = one.stands_for or one.metavar.lower()
    before, comma, _ = last.rpartition(",")
    for word, about in sorted(dict(_found(kind, file.parent)).items()):
        yield f"{before}{comma}{word}", about


def _found(kind: str, folder: Path) -> Iterator[Offer]:
    """Yield the words of a kind: without agents, from the files in a folder."""
    if kind == "job":
        yield from ((path.stem, str(path)) for path in folder.glob("*.job"))
    elif kind == "rmod":
        for paths in (_LIBRARY.glob("*/*.rmod"), folder.glob("*.rmod")):
            yield from ((path.stem, str(path)) for path in paths)
    elif kind in _RESOURCES:
        from pbonet.xm.ipc import overview

        yield from ((name, "") for name in overview.names_here(_RESOURCES[kind]))
    elif kind == "field":
        from pbonet.master.subsystem import status_fields

        yield from ((field.name, field.doc) for field in status_fields.FIELDS)
    elif kind == "what":  # that `explain` explains
        yield from _QUESTIONS
        for one in _KEYWORDS:
            yield from _found(one, folder)
    elif kind in _KEYWORDS:
        keyword, ending = _KEYWORDS[kind]
        line = re.compile(rf"^[ \t]*{keyword}[ \t]+(\S+)", re.MULTILINE)
        for path in folder.glob(f"*.{ending}"):
            text = path.read_text(encoding="utf-8", errors="replace")
            yield from ((name, str(path)) for name in line.findall(text))


_RESOURCES: Final = {"semaphore": "sem", "queue": "queue", "mailbox": "mailbox"}
"""Kinds of resources by the words that stand for their names."""
_KEYWORDS: Final = {
    "task": ("TASK", "job"),
    "rtpu": ("RTPU", "sbs"),
    "variable": ("NAME", "svar"),
}
"""The word with which a line begins that names a thing, and the ending of its file."""
_QUESTIONS: Final = (
    ("flag", "why the illegal-configuration flag is up"),
    ("start", "why a job would be refused"),
    ("miss", "why a task has missed cycles"),
)


def install(shell: str) -> list[Path]:
    """Write the script of a shell, have new shells read it, and return what changed."""
    home = Path.home()
    if shell == "fish":
        config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
        script, start, line = config / "fish" / "completions" / "pbonet.fish", None, ""
    elif shell == "zsh":
        script = home / ".zfunc" / "_pbonet"
        start = Path(os.environ.get("ZDOTDIR") or home) / ".zshrc"
        folder = shlex.quote(str(script.parent))
        line = f"fpath+=({folder}); autoload -Uz compinit; compinit"
    else:
        script, start = home / ".bash_completions" / "pbonet.sh", home / ".bashrc"
        line = f"source {shlex.quote(str(script))}"
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(SCRIPTS[shell])
    if start is None:
        return [script]
    before = start.read_text() if start.exists() else ""
    if line not in before.splitlines():
        gap = "" if before.endswith("\n") or not before else "\n"
        start.write_text(f"{before}{gap}{line}\n")
    return [script, start]
