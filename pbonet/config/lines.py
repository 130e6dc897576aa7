"""Lines and words of a configuration file, and the errors that name their places."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

from pbonet.errors import ConfigError, did_you_mean

from .model import Place

if TYPE_CHECKING:
    from collections.abc import Iterable

WORD = re.compile(r"[^ \t]+")
"""A word: text between spaces and tabs."""

LONGEST_QUOTE = 40
"""Longest text in messages; longer text is shortened."""


class Word(NamedTuple):
    """One word of a line, its place, and the keyword before it."""

    text: str
    place: Place
    keyword: str = ""


class Line(NamedTuple):
    """A keyword and what follows it, as written."""

    keyword: str
    rest: str
    place: Place
    rest_column: int

    @property
    def words(self) -> list[Word]:
        """The arguments; a word that begins with ``#`` starts a comment."""
        found: list[Word] = []
        for match in WORD.finditer(self.rest):
            if match[0].startswith("#"):
                break
            column = self.rest_column + match.start()
            place = Place(self.place.file, self.place.line, column)
            found.append(Word(match[0], place, self.keyword))
        return found


def quote(text: str, longest: int = LONGEST_QUOTE) -> str:
    """Return `text` in quotes, shortened and with unprintable characters escaped."""
    if len(text) > longest:
        text = text[: longest - 3] + "..."
    shown = (
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )
    return f"'{''.join(shown)}'"


def fault(
    what: str, place: Place, *, expected: str = "", got: str = "", remedy: str = ""
) -> ConfigError:
    """Return the error `what` at `place`."""
    return ConfigError(
        what, where=str(place), expected=expected, got=got, remedy=remedy
    )


def nearest(word: str, *known: Iterable[str]) -> str:
    """Return ``did you mean NAME?`` out of the first list that has a near name.

    Names that differ in case only count as equal to the word.
    """
    for names in known:
        folded = {name.casefold(): name for name in names}
        if name := folded.get(word.casefold()):
            return f"did you mean {name}?"
    for names in known:
        if len(word) <= LONGEST_QUOTE and (hint := did_you_mean(word, names)):
            return hint
    return ""
