"""The line-oriented reader under every configuration file (section 5.5.2).

A file is lines of a keyword and its arguments. Blank lines and lines that begin with
``#`` mean nothing; ``DEFINE NAME value`` gives a word a value for the lines below it;
the last line is ``EOF``, so that a file cut short is noticed. What order the keywords
have is the business of `pbonet.config.blocks`, what their arguments mean that of
`pbonet.config.words` and of each format's own file.
"""

from __future__ import annotations

import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.errors import ConfigError, ConfigFileError

from .constants import Constants
from .lines import WORD, Line, fault, nearest, quote
from .model import Place

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

MAX_FILE = 16 << 20
"""Longest file, in bytes."""
MAX_LINE = 1 << 20
"""Longest line, in characters."""

_FIRST = {
    "NAME": ".svar",
    "MODULE": ".rmod",
    "SUBSYSTEM": ".sbs",
    "JOB": ".job",
    "SEQUENCE": ".seq",
}
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x0c\x0e-\x1f\x7f]|\r(?!\n)")


def _format_of(keyword: str) -> str:
    ending = _FIRST.get(keyword)
    return f"is this a {ending} file?" if ending else ""


def load(path: str | Path) -> str:
    """Return the text of a configuration file.

    Raises:
        ConfigFileError: It is missing, unreadable, too long, or not UTF-8 text.
    """
    path = Path(path)
    data = None
    try:
        if stat.S_ISREG(path.stat().st_mode):
            with path.open("rb") as stream:
                data = stream.read(MAX_FILE + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigFileError(
            f"the file cannot be read: {reason}",
            where=str(path),
            remedy=similar_file(path) or "check the path and its permissions",
        ) from None
    if data is None:
        raise ConfigFileError(
            "this is not a regular file",
            where=str(path),
            remedy="name a configuration file",
        )
    return decode(data, str(path))


def similar_file(path: Path) -> str:
    """Return a hint when the folder holds a file of that kind with nearly the name.

    A name without an ending is that of all configuration files that have an ending
    after it.
    """
    try:
        beside = list(path.parent.iterdir())
    except (OSError, ValueError):
        return ""
    if not path.suffix:
        named = [path.with_name(path.name + ending) for ending in _FIRST.values()]
        found = [str(one) for one in named if one in beside]
        return f"did you mean {' or '.join(found)}?" if found else ""
    names = [entry.name for entry in beside if entry.suffix == path.suffix]
    import difflib  # only where something is wrong

    near = difflib.get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / near[0]}?" if near else ""


def decode(data: bytes, file: str) -> str:
    """Return `data` as text without byte order mark.

    Raises:
        ConfigFileError: It is too long or not UTF-8.
    """
    if len(data) > MAX_FILE:
        raise ConfigFileError(
            "the file is too long",
            where=file,
            expected=f"at most {MAX_FILE} bytes",
            remedy="this is probably not a configuration file; name another",
        )
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ConfigFileError(
            "the file is encoded in UTF-16",
            where=f"{file}:1:1",
            expected="UTF-8 or ASCII text",
            remedy="save it as UTF-8",
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        line = before.count(b"\n") + 1
        column = error.start - (before.rfind(b"\n") + 1) + 1
        raise ConfigFileError(
            "the file is not text",
            where=f"{file}:{line}:{column}",
            expected="UTF-8 or ASCII text",
            got=f"byte 0x{data[error.start]:02x}",
            remedy="save it as UTF-8; is it a configuration file at all?",
        ) from None


class Reader:
    """Hands out the lines of one text, after comments and DEFINE lines.

    Args:
        text: The text; bytes are decoded as a file's would be.
        file: Its name, for messages.
        keywords: Every keyword the format knows beside DEFINE and EOF.
        stray: What to do about a keyword that is like none of them.
    """

    def __init__(
        self,
        text: str | bytes,
        file: str,
        keywords: Iterable[str],
        *,
        stray: str = "correct the keyword or remove the line",
    ) -> None:
        self.file = file
        self._stray = stray
        self.keywords = (*keywords, "DEFINE", "EOF")
        self.text = (
            decode(text, file) if isinstance(text, bytes) else _clean(text, file)
        )
        _refuse_control(self.text, file)
        self.constants = Constants(self.text)
        self._lines = self._meaningful()
        self._ahead: Line | None = None
        self._begun = False
        self._last = Place(file, 1)

    def peek(self) -> Line:
        """Return the next line without taking it.

        Raises:
            ConfigError: There is none, so ``EOF`` is missing; or it is malformed.
        """
        if self._ahead is None:
            self._ahead = next(self._lines, None)
        if self._ahead is None:
            raise self._cut_short()
        return self._ahead

    def take(self) -> Line:
        """Return the next line and move past it."""
        line = self.peek()
        self._ahead = None
        self._begun = True
        return line

    def finish(self) -> None:
        """Take ``EOF`` and make sure that nothing follows it.

        Raises:
            ConfigError: Another line is here, or text after ``EOF``.
        """
        line = self.take()
        if line.keyword != "EOF":
            raise self.unknown(line, ("EOF",))
        if line.words:
            raise fault(
                "there is text after EOF on its line",
                line.words[0].place,
                expected="EOF alone on the last line",
                got=quote(line.rest),
                remedy="remove it",
            )
        surplus = next(self._raw_lines(self._last.line), None)
        if surplus is not None:
            raise fault(
                "there is text after the EOF line",
                surplus.place,
                expected=f"EOF (line {line.place.line}) as the last line",
                got=quote(surplus.keyword),
                remedy="remove the text, or move EOF after it",
            )

    def after(self, line: Line) -> Iterator[Line]:
        """Yield the lines that follow one, without taking them."""
        return self._raw_lines(line.place.line)

    def unknown(self, line: Line, expected: Iterable[str]) -> ConfigError:
        """Return the error for a line with an unknown keyword.

        A first line like no configuration file's is not quoted: it may be a secret of
        a file that was named by mistake, or to learn what it holds.
        """
        expected = tuple(expected)
        hint = nearest(line.keyword, expected, self.keywords)
        hint = hint or _format_of(line.keyword)
        if not hint and not self._begun:
            return fault(
                "the first line has no keyword of this kind of file",
                line.place,
                expected=" or ".join(expected),
                got="another word",
                remedy="correct the keyword, or name the right file",
            )
        return fault(
            f"unknown keyword {quote(line.keyword)}",
            line.place,
            expected=" or ".join(expected),
            remedy=hint or self._stray,
        )

    def _cut_short(self) -> ConfigError:
        if not self.text.strip():
            return ConfigError(
                "the file is empty",
                where=str(Place(self.file, 1)),
                expected="keyword lines and EOF as the last line",
                remedy="was it cut short?",
            )
        return fault(
            "EOF is missing: file cut short?",
            self._last,
            expected="EOF as the last line",
            got="the end of the file",
            remedy="restore the file, or add EOF if nothing is lost",
        )

    def _meaningful(self) -> Iterator[Line]:
        """Yield lines other than DEFINE; those are carried out in passing."""
        for line in self._raw_lines(0):
            self._last = line.place
            if line.keyword == "DEFINE":
                self.constants.define(line)
            else:
                yield line

    def _raw_lines(self, after: int) -> Iterator[Line]:
        """Yield lines that are neither blank nor comments, after line `after`."""
        start, number = 0, 0
        while start <= len(self.text):
            end = self.text.find("\n", start)
            end = len(self.text) if end < 0 else end
            number += 1
            if number > after:
                if end - start > MAX_LINE:
                    raise fault(
                        "the line is too long",
                        Place(self.file, number),
                        expected=f"at most {MAX_LINE} characters",
                        got=f"{end - start}",
                        remedy="is this a configuration file at all?",
                    )
                content = self.text[start:end].rstrip(" \t\r")
                word = WORD.search(content)
                if word and not word[0].startswith("#"):
                    yield self._line(content, word, number)
            start = end + 1

    def _line(self, content: str, word: re.Match[str], number: int) -> Line:
        behind = content[word.end() :]
        rest = behind.lstrip(" \t")
        column = word.end() + (len(behind) - len(rest)) + 1
        return Line(word[0], rest, Place(self.file, number, word.start() + 1), column)


def _clean(text: str, file: str) -> str:
    if len(text) > MAX_FILE:
        return decode(text.encode("utf-8", "replace"), file)
    return text.removeprefix("\ufeff")


def _refuse_control(text: str, file: str) -> None:
    """Refuse control characters other than tab and the ends of lines."""
    if match := _CONTROL.search(text):
        at = match.start()
        line = text.count("\n", 0, at) + 1
        raise ConfigFileError(
            "the file contains a control character",
            where=f"{file}:{line}:{at - text.rfind(chr(10), 0, at)}",
            expected="text with spaces, tabs and line ends only",
            got=f"0x{ord(text[at]):02x}",
            remedy="remove it; is it a configuration file at all?",
        )
