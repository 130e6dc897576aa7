"""From the words of a command line to the exit status of its verb."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError

from . import verbs
from .parser import UsageError, Verb, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

_HELP = {"-h", "--help"}


def run(words: Sequence[str]) -> int:
    """Carry out a command line and return its status."""
    try:
        if words and words[0] == "--complete":
            return _complete(words[1], words[2:])
        return _help([]) if not words else _verb(list(words))
    except UsageError as error:
        sys.stderr.write(f"pbonet: {error}\n")
        return 2


def _verb(words: list[str]) -> int:
    if words[0] in _HELP:
        return _help([])
    found, rest = verbs.find(words)
    if not isinstance(found, Verb) or _asks_help(rest):
        return _help(words)
    try:
        given = parse(found, rest)
    except UsageError as error:
        raise UsageError(
            f"{error}\nusage: {found.usage}\n'pbonet {found.name} --help' explains it"
        ) from None
    as_data, debug = bool(given.get("json_")), bool(given["debug"])
    try:
        return found.call(given)
    except PbonetError as error:
        _show(error, as_data=as_data, debug=debug)
        return 1


def _asks_help(words: list[str]) -> bool:
    before = words[: words.index("--")] if "--" in words else words
    return not _HELP.isdisjoint(before)


def _help(words: list[str]) -> int:
    from . import help as help_

    if not words:
        print(help_.program())
        return 0
    found, _ = verbs.find(words)
    print(help_.verb(found) if isinstance(found, Verb) else help_.family(found))
    return 0


def _complete(shell: str, words: Sequence[str]) -> int:
    from . import completing

    for line in completing.lines(shell, words):
        print(line)
    return 0


def _show(error: PbonetError, *, as_data: bool, debug: bool) -> None:
    """Show an error as data or as text, with its stack if that is asked for.

    Warnings that came before it are its notes.
    """
    warnings: list[str] = getattr(error, "__notes__", [])
    if as_data:
        import msgspec

        found = {"error": error.to_wire(), "warnings": warnings}
        print(msgspec.json.encode(found).decode())
    else:
        for warning in warnings:
            sys.stderr.write(f"WARNING> {warning}\n")
        sys.stderr.write(f"pbonet: {error}\n")
    if debug:
        import traceback

        sys.stderr.write(f"{error.debug.rstrip()}\n" if error.debug else "")
        sys.stderr.write("".join(traceback.format_exception(error)))
