"""DEFINE: words that stand for values (section 5.5.2)."""

from __future__ import annotations

import re

from pbonet.errors import ConfigError

from .lines import LONGEST_QUOTE, Line, Word, fault, nearest, quote

MAX_NESTING = 32
"""Deepest chain of a DEFINE that names another one."""

_CONSTANT = re.compile(r"([+-]?)([A-Za-z_][A-Za-z0-9_]*)")
_NUMBER = re.compile(r"[+-]?(?:\d|\.\d|inf\b|nan\b)", re.ASCII)


class Constants:
    """Constants that DEFINE lines gave so far.

    Args:
        text: The whole file, to find a DEFINE that comes too late.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._defined: dict[str, Word] = {}

    @property
    def words(self) -> dict[str, str]:
        """The constants as written."""
        return {name: word.text for name, word in self._defined.items()}

    def define(self, line: Line) -> None:
        """Carry out one DEFINE line.

        Raises:
            ConfigError: It is malformed, repeats a name, or defines it by itself.
        """
        words = line.words
        if len(words) != 2:  # noqa: PLR2004 - a name and its value
            raise fault(
                "a DEFINE needs a name and one value",
                line.place,
                expected="DEFINE NAME value",
                got=f"{len(words)} words after DEFINE",
                remedy="write one constant a line",
            )
        name, value = words
        match = _CONSTANT.fullmatch(name.text)
        if match is None or match[1]:
            raise fault(
                f"{quote(name.text)} cannot be the name of a constant",
                name.place,
                expected="a letter or _, then letters, digits and _",
                remedy="choose another name",
            )
        if name.text in self._defined:
            first = self._defined[name.text].place.line
            raise fault(
                f"the constant {quote(name.text)} is defined twice",
                name.place,
                expected="one DEFINE for each constant",
                got=f"another one in line {first}",
                remedy="remove one of them",
            )
        self._defined[name.text] = value
        self._refuse_recursion(name)

    def _refuse_recursion(self, name: Word) -> None:
        chain = [name.text]
        while match := _CONSTANT.fullmatch(self._defined[chain[-1]].text):
            follower = match[2]
            if follower in chain:
                raise fault(
                    f"the constant {quote(name.text)} is defined by itself",
                    name.place,
                    expected="a value, or a constant that has one",
                    got=" -> ".join([*chain, follower]),
                    remedy="give one of them a number",
                )
            if follower not in self._defined:
                return
            chain.append(follower)
            if len(chain) > MAX_NESTING:
                raise self._too_deep(name)

    @staticmethod
    def _too_deep(word: Word) -> ConfigError:
        return fault(
            f"the constant {quote(word.text)} is nested too deeply",
            word.place,
            expected=f"at most {MAX_NESTING} constants in a chain",
            remedy="give it its value",
        )

    def replace(self, word: Word) -> str:
        """Return the word's text with a constant's name replaced by its value.

        ``-NAME`` is replaced too if the constant is a number.
        """
        text = word.text
        for _ in range(MAX_NESTING):
            match = _CONSTANT.fullmatch(text)
            if match is None or not self._known(match[2], word):
                return text
            sign, name = match.groups()
            value = self._defined[name].text
            text = _negate(value) if sign == "-" else value
            if sign and not (_NUMBER.match(value) or _CONSTANT.fullmatch(value)):
                raise fault(
                    f"{quote(word.text)} needs a constant that is a number",
                    word.place,
                    expected=f"a number as the value of {name}",
                    got=quote(value),
                    remedy="remove the sign or change the DEFINE",
                )
        raise self._too_deep(word)

    def _known(self, name: str, word: Word) -> bool:
        """Return whether the constant is defined above the word that names it."""
        value = self._defined.get(name)
        return value is not None and value.place.line < word.place.line

    def undefined(self, word: Word, wanted: str) -> ConfigError:
        """Return the error for a word that is neither a number nor a constant."""
        text = self.replace(word)
        match = _CONSTANT.fullmatch(text)
        if match is None:
            return fault(
                f"{quote(text)} is not a number",
                word.place,
                expected=wanted,
                remedy=_without_unit(text) or "write numbers as in 2.5, -3 or 1e-3",
            )
        name = match[2][:LONGEST_QUOTE]
        behind = "" if text == word.text else f", the value of {quote(word.text)}"
        later = re.search(
            rf"^[ \t]*DEFINE[ \t]+{name}(?![^\s])", self._text, re.MULTILINE
        )
        if later:
            line = self._text.count("\n", 0, later.start()) + 1
            remedy = f"move its DEFINE from line {line} above this line"
        else:
            known = [other for other in self._defined if self._known(other, word)]
            remedy = nearest(name, known) or f"add DEFINE {name} above"
        return fault(
            f"the constant {quote(name)} is not defined{behind}",
            word.place,
            expected=f"{wanted}, or a constant with such a value",
            remedy=remedy,
        )


def _without_unit(text: str) -> str:
    """Return what to write in place of a number followed by a unit, if it is one."""
    match = re.fullmatch(r"([+-]?[0-9]*\.?[0-9]+)([a-zA-Z]{1,3})", text)
    if match is None:
        return ""
    scale = _SCALE.get(match[2])
    if scale is None:
        return "omit the unit; convert the number to the expected unit"
    return f"omit the unit and write {float(match[1]) * scale:.12g}"


_SCALE = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "s": 1.0, "ms": 1e-3, "us": 1e-6}
"""By what a number is multiplied when its unit is left out: files have Hz and s."""


def _negate(text: str) -> str:
    """Return the text of the number or constant with its sign turned round."""
    if text.startswith("-"):
        return text[1:]
    return "-" + text.removeprefix("+")
