"""TOML: its text to a table, and a table to a record; errors have their place."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from pbonet.errors import ConfigError

from .lines import fault, quote
from .model import Place
from .reader import MAX_LINE

if TYPE_CHECKING:
    from collections.abc import Mapping

_Record = TypeVar("_Record", bound=msgspec.Struct)

LONGEST_REASON = 100
"""Longest reason of the parser in a message; one may hold a key of any length."""

_AT = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")


def toml_table(text: str, file: str) -> dict[str, Any]:
    """Return the table that the text is; `file` is its name in messages.

    Raises:
        ConfigError: It is not TOML; the message has line and column.
    """
    import tomllib  # most agents have no file

    _refuse_long_lines(text, file)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        message = str(error)
        match = _AT.search(message)
        if match and match[1]:
            place = Place(file, int(match[1]), int(match[2]))
        elif match:
            last = text.rstrip("\n")
            line = last.count("\n") + 1
            place = Place(file, line, len(last) - (last.rfind("\n") + 1) + 1)
        else:
            place = Place(file, 1)
        reason = _AT.sub("", message)
        if isinstance(error, RecursionError):
            reason = "nested too deeply"
        raise fault(
            f"this is not TOML: {quote(reason, LONGEST_REASON)[1:-1]}",
            place,
            expected="key = value",
            remedy="write texts in quotes, lists in brackets",
        ) from None


def _refuse_long_lines(text: str, file: str) -> None:
    start, number = 0, 0
    while start <= len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        number += 1
        if end - start > MAX_LINE:
            raise fault(
                "the line is too long",
                Place(file, number),
                expected=f"at most {MAX_LINE} characters",
                got=f"{end - start}",
                remedy="is this a configuration file at all?",
            )
        start = end + 1


def toml_record(
    table: Mapping[str, Any], kind: type[_Record], file: str, *, remedy: str
) -> _Record:
    """Return the record that a table is.

    Args:
        table: What `toml_table` has read.
        kind: The record's class.
        file: The file's name in messages.
        remedy: What to do about a value that cannot be.

    Raises:
        ConfigError: A key is missing or has a value of a wrong type.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        what, _, where = str(error).partition(" - at ")
        key = where.strip("`").removeprefix("$").lstrip(".")
        raise ConfigError(
            "the file says something that cannot be",
            where=f"{file}: {key}" if key else file,
            got=what,
            remedy=remedy,
        ) from None
