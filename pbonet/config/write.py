"""Parts that the writers of all formats share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, cast

import msgspec

from pbonet.errors import ConfigError

Record = TypeVar("Record", bound=msgspec.Struct)

_PLACES = frozenset({"file", "place", "places"})


def text_line(keyword: str, text: str) -> str:
    """Return one line of a keyword and its argument."""
    return f"{keyword:<9} {text}".rstrip(" \t") + "\n"


def number(value: float) -> str:
    """Return the shortest text that reads back as exactly `value`."""
    return repr(int(value)) if isinstance(value, int) else repr(float(value))


def meaning(record: msgspec.Struct) -> object:
    """Return a record without the places in its file.

    Two records mean the same if these are equal; NaN equals NaN here.
    """
    return _meaning(msgspec.to_builtins(record))


def _meaning(value: object) -> object:
    if isinstance(value, Mapping):
        items = cast("Mapping[str, Any]", value).items()
        return {key: _meaning(inner) for key, inner in items if key not in _PLACES}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_meaning(inner) for inner in cast("Sequence[object]", value)]
    if isinstance(value, float) and math.isnan(value):
        return "nan"
    return value


def same_again(record: Record, text: str, parse: Callable[[str, str], Record]) -> str:
    """Return `text` after making sure that it reads back as `record`.

    Raises:
        ConfigError: It does not, so no file can say what the record says.
    """
    file = str(getattr(record, "file", ""))
    try:
        again = parse(text, file)
    except ConfigError as error:
        raise ConfigError(
            "the record cannot be written as a file",
            where=file,
            expected="a record as the reader returns it",
            got=str(error),
            remedy="correct the record",
        ) from error
    if meaning(again) != meaning(record):
        raise ConfigError(
            "the record would mean something else after writing and reading",
            where=file,
            expected="a record as the reader returns it",
            remedy="check texts for line ends, spaces at their ends and #",
        )
    return text
