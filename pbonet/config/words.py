"""Meaning of the words after a keyword: names, numbers, choices.

Every function takes the reader, for its constants, and raises `ConfigError` with the
word's place, what was expected and what to do.
"""

from __future__ import annotations

import math
import re
from enum import StrEnum
from typing import TYPE_CHECKING, TypeVar

from .lines import Line, Word, fault, nearest, quote
from .reader import Reader

if TYPE_CHECKING:
    from pbonet.errors import ConfigError

    from .types import ElementType

MAX_NAME = 15
"""Longest name of a variable (section 5.5.2)."""
MAX_LABEL = 31
"""Longest name of a task, RTPU, subsystem, job or module."""

_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_^'.]*")
_LABEL = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
_MODULE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FLOAT = re.compile(
    r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?inf|nan"
)
_INT = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]+|[0-9]+)")
_LONGEST_NUMBER = 64
_BOOLS = {"0": 0, "1": 1, "false": 0, "true": 1}

Choice = TypeVar("Choice", bound=StrEnum)


def single(line: Line, what: str) -> Word:
    """Return the one word after the keyword; `what` names it in messages."""
    words = line.words
    if len(words) != 1:
        got = f"{len(words)} words" if words else "nothing"
        raise fault(
            f"{line.keyword} needs {what}",
            words[1].place if words else line.place,
            expected="one word",
            got=got,
            remedy=f"write {line.keyword} and {what}, and nothing else",
        )
    return words[0]


def path(line: Line, what: str) -> str:
    """Return the file name after the keyword; it may hold spaces."""
    if not line.rest:
        raise fault(
            f"{line.keyword} needs {what}",
            line.place,
            expected=what,
            got="nothing",
            remedy=f"write {line.keyword} and {what}",
        )
    return line.rest


def variable(word: Word, what: str = "a variable") -> str:
    """Return the word as a name of at most 15 characters."""
    if len(word.text) > MAX_NAME:
        raise fault(
            f"the name {quote(word.text)} is too long",
            word.place,
            expected=f"at most {MAX_NAME} characters",
            got=f"{len(word.text)}",
            remedy="shorten it everywhere it is used",
        )
    if not _VARIABLE.fullmatch(word.text) or word.text.lower() == "none":
        raise fault(
            f"{quote(word.text)} cannot be the name of {what}",
            word.place,
            expected="a letter or _, then letters, digits and any of _ ^ ' .",
            remedy="choose another name",
        )
    return word.text


def label(word: Word, what: str) -> str:
    """Return the word as the name of a task, RTPU, subsystem or job."""
    return _checked(word, what, _LABEL, "letters, digits, _ and -")


def module(word: Word) -> str:
    """Return the word as the name of a module."""
    return _checked(word, "a module", _MODULE, "letters, digits and _")


def _checked(word: Word, what: str, pattern: re.Pattern[str], signs: str) -> str:
    if len(word.text) > MAX_LABEL or not pattern.fullmatch(word.text):
        raise fault(
            f"{quote(word.text)} cannot be the name of {what}",
            word.place,
            expected=f"a letter or _, then {signs}, at most {MAX_LABEL} in all",
            remedy="choose another name",
        )
    return word.text


def choice(word: Word, kinds: type[Choice], what: str) -> Choice:
    """Return the member of `kinds` that the word names."""
    for member in kinds:
        if member.value == word.text:
            return member
    values = [member.value for member in kinds]
    raise fault(
        f"{quote(word.text)} is not {what}",
        word.place,
        expected=" or ".join(values),
        remedy=nearest(word.text, values) or f"write one of {', '.join(values)}",
    )


def yes(line: Line) -> bool:
    """Return the value of a line with yes or no."""
    word = single(line, "yes or no")
    if word.text not in {"yes", "no"}:
        raise fault(
            f"{line.keyword} is neither yes nor no",
            word.place,
            expected="yes or no",
            got=quote(word.text),
            remedy=nearest(word.text, ("yes", "no")) or "write yes or no",
        )
    return word.text == "yes"


def whole(reader: Reader, word: Word, low: int, high: int) -> int:
    """Return the word as a whole number from `low` to `high`."""
    wanted = f"a whole number from {low} to {high}"
    text = reader.constants.replace(word)
    if len(text) > _LONGEST_NUMBER or not _INT.fullmatch(text):
        raise _no_number(reader, word, text, wanted)
    value = int(text, 16) if "x" in text.lower() else int(text)
    if not low <= value <= high:
        raise _outside(word, text, wanted)
    return value


def real(
    reader: Reader,
    word: Word,
    wanted: str,
    *,
    low: float = 0.0,
    high: float = math.inf,
    open_low: bool = True,
    open_high: bool = True,
) -> float:
    """Return the word as a finite number between two bounds.

    Args:
        reader: For its constants.
        word: The word.
        wanted: The number in words, with its unit, for messages.
        low: The lower bound.
        high: The upper bound.
        open_low: Whether `low` itself is refused.
        open_high: Whether `high` itself is refused.
    """
    text = reader.constants.replace(word)
    if len(text) > _LONGEST_NUMBER or not _FLOAT.fullmatch(text):
        raise _no_number(reader, word, text, wanted)
    value = float(text)
    above = value > low if open_low else value >= low
    below = value < high if open_high else value <= high
    if not (above and below and math.isfinite(value)):
        raise _outside(word, text, wanted)
    return value


def element(
    reader: Reader, word: Word, kind: ElementType, *, finite: bool
) -> float | int:
    """Return the word as a value of one element.

    Args:
        reader: For its constants.
        word: The word.
        kind: The element's type; not a struct.
        finite: Whether infinities and NaN are refused.
    """
    wanted = kind.values
    text = reader.constants.replace(word)
    if kind.is_bool:
        if text not in _BOOLS:
            raise _no_number(reader, word, text, wanted)
        return _BOOLS[text]
    if not kind.is_float:
        return whole(reader, word, int(kind.low), int(kind.high))
    if len(text) > _LONGEST_NUMBER or not _FLOAT.fullmatch(text):
        raise _no_number(reader, word, text, wanted)
    value = float(text)
    named = "inf" in text or text == "nan"
    if named and finite:
        raise _outside(word, text, wanted, "correct the value, or add FINITE no")
    if not named and abs(value) > kind.high:
        raise _outside(word, text, wanted)
    return value


def _no_number(reader: Reader, word: Word, text: str, wanted: str) -> ConfigError:
    if _FLOAT.fullmatch(text) or len(text) > _LONGEST_NUMBER:
        return _outside(word, text, wanted)
    return reader.constants.undefined(word, wanted)


def _outside(
    word: Word, text: str, wanted: str, remedy: str = "correct the value"
) -> ConfigError:
    stands = f", whose value is {quote(text)}" if text != word.text else ""
    return fault(
        f"{word.keyword} cannot be {quote(word.text)}{stands}",
        word.place,
        expected=wanted,
        remedy=remedy,
    )
