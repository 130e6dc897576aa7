"""The text of ``--help``: of the program, of a family of verbs, and of one verb."""

from __future__ import annotations

import shutil
import textwrap
from typing import TYPE_CHECKING

from . import verbs

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .parser import Parameter, Verb

_WIDEST = 100
_GAP = 2
_COLUMN = 24
"""Longest word with its explanation on the same line."""

_ABOUT = """\
pbonet assembles a robot's control software from ready modules and changes it while it
runs. A subsystem (.sbs) has RTPUs (executors: a core each, with an agent) that run its
tasks. A task runs a module with the settings of an .rmod file (module configuration). A
job (.job) is a set of tasks. Tasks exchange values by shared variables (.svar)."""


def program() -> str:
    """Return the help of the program: all verbs in groups."""
    lines = [*_wrapped(_ABOUT.replace("\n", " ")), "", "usage: pbonet VERB ...", ""]
    for title, names in verbs.GROUPS.items():
        rows = [(name, verbs.summary(name)) for name in names]
        lines += [f"{title}:", *_table(rows), ""]
    options = [
        ("-h, --help", "Show this help, or that of a verb."),
        ("--version", "Show the version."),
    ]
    lines += ["Options:", *_table(options), ""]
    lines += ["'pbonet VERB --help' explains a verb, with examples."]
    return "\n".join(lines)


def family(one: verbs.Family) -> str:
    """Return the help of a family of verbs."""
    rows = [(verb.name.split()[-1], verb.summary) for verb in one.verbs.values()]
    return "\n".join([
        f"usage: pbonet {one.name} VERB ...",
        "",
        *_wrapped(one.help),
        "",
        "Verbs:",
        *_table(rows),
        "",
        f"'pbonet {one.name} VERB --help' explains a verb, with examples.",
    ])


def verb(one: Verb) -> str:
    """Return the help of a verb."""
    lines = [f"usage: {one.usage}", ""]
    for paragraph in one.help.split("\n\n"):
        lines += [*_wrapped(paragraph.replace("\n", " ")), ""]
    if one.arguments:
        rows = [(part.metavar, _about(part)) for part in one.arguments]
        lines += ["Arguments:", *_table(rows), ""]
    rows = [(_names(part), _about(part)) for part in one.options]
    rows.append(("-h, --help", "Show this help."))
    lines += ["Options:", *_table(rows), ""]
    lines.append("Examples:")
    for command, purpose in one.examples:
        lines += [f"  {command}", *_wrapped(purpose, "      ")]
    return "\n".join(lines)


def _names(part: Parameter) -> str:
    names = ", ".join(part.all_names)
    return names if part.is_switch else f"{names} {part.metavar}"


def _about(part: Parameter) -> str:
    """Return what a parameter is for, with its default, range and variable."""
    notes: list[str] = []
    if part.many and part.names:
        notes.append("may be repeated")
    if part.default not in {None, False, True, ""} and str(part.default) != ".":
        notes.append(f"default: {part.default}")
    if part.least is not None and part.most is not None:
        notes.append(f"{part.least:g} to {part.most:g}")
    elif part.least is not None:
        notes.append(f"at least {part.least:g}")
    if part.env:
        notes.append(f"or {part.env}")
    return f"{part.help} [{'; '.join(notes)}]" if notes else part.help


def _table(rows: Iterable[tuple[str, str]]) -> list[str]:
    rows = list(rows)
    column = max(len(word) for word, _ in rows if len(word) <= _COLUMN)
    lines: list[str] = []
    for word, about in rows:
        texts = _wrapped(about, " " * (column + 2 * _GAP))
        if len(word) > column:
            lines.append(f"  {word}")
        else:
            texts[0] = f"  {word:{column}}  {texts[0].strip()}"
        lines += texts
    return lines


def _wrapped(text: str, indent: str = "") -> list[str]:
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    return textwrap.wrap(
        text,
        max(width, 2 * _COLUMN + len(indent)),
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
    )
