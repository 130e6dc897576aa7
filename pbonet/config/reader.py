"""The line-oriented reader under every configuration file (section 5.5.2).

A file is lines of a keyword and its arguments. Blank lines and lines that begin with
``#`` mean nothing; ``DEFINE NAME value`` gives a word a value for the lines below it;
the last line is ``EOF``, so that a file cut short is noticed. What order the keywords
have is the business of `pbonet.config.blocks`, what their arguments mean that of
`pbonet.config.words` and of each format's own file.
"""

from __future__ import annotations

import difflib
import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pbonet.errors import ConfigError, ConfigFileError, did_you_mean

from .model import Place

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

MAX_FILE = 16 << 20
"""Longest file, in bytes."""
MAX_LINE = 1 << 20
"""Longest line, in characters."""
MAX_NESTING = 32
"""Deepest chain of a DEFINE that names another one."""

_LONGEST_QUOTE = 40
_FIRST = {"NAME": ".svar", "MODULE": ".rmod", "SUBSYSTEM": ".sbs", "JOB": ".job"}
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x0c\x0e-\x1f\x7f]|\r(?!\n)")
_WORD = re.compile(r"[^ \t]+")
_CONSTANT = re.compile(r"([+-]?)([A-Za-z_][A-Za-z0-9_]*)")
_NUMBER = re.compile(r"[+-]?(?:\d|\.\d|inf\b|nan\b)", re.ASCII)


class Word(NamedTuple):
    """One word of a line, its place, and the keyword it stands behind."""

    text: str
    place: Place
    keyword: str = ""


class Line(NamedTuple):
    """A keyword and what stands behind it, as written."""

    keyword: str
    rest: str
    place: Place
    rest_column: int

    @property
    def words(self) -> list[Word]:
        """The arguments; a word that begins with ``#`` starts a comment."""
        found: list[Word] = []
        for match in _WORD.finditer(self.rest):
            if match[0].startswith("#"):
                break
            column = self.rest_column + match.start()
            place = Place(self.place.file, self.place.line, column)
            found.append(Word(match[0], place, self.keyword))
        return found


def quote(text: str) -> str:
    """Return `text` in quotes, shortened and with unprintable characters escaped."""
    if len(text) > _LONGEST_QUOTE:
        text = text[: _LONGEST_QUOTE - 3] + "..."
    shown = (
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )
    return f"'{''.join(shown)}'"


def fault(
    what: str, place: Place, *, expected: str = "", got: str = "", remedy: str = ""
) -> ConfigError:
    """Return the error that says `what` is wrong at `place`."""
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
        if len(word) <= _LONGEST_QUOTE and (hint := did_you_mean(word, names)):
            return hint
    return ""


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
            remedy=_similar_file(path) or "check the path and its permissions",
        ) from None
    if data is None:
        raise ConfigFileError(
            "this is not a regular file",
            where=str(path),
            remedy="name a configuration file",
        )
    return decode(data, str(path))


def _similar_file(path: Path) -> str:
    """Return a hint when the folder holds a file of nearly that name."""
    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except (OSError, ValueError):
        return ""
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
            remedy="this is hardly a configuration file; name another",
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
    """

    def __init__(self, text: str | bytes, file: str, keywords: Iterable[str]) -> None:
        self.file = file
        self.keywords = (*keywords, "DEFINE", "EOF")
        self.text = (
            decode(text, file) if isinstance(text, bytes) else _clean(text, file)
        )
        _refuse_control(self.text, file)
        self.constants = Constants(self)
        self._lines = self._meaningful()
        self._ahead: Line | None = None
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
        """Return the next line and go on behind it."""
        line = self.peek()
        self._ahead = None
        return line

    def finish(self) -> None:
        """Take ``EOF`` and make sure that nothing stands behind it.

        Raises:
            ConfigError: Another line stands here, or text behind ``EOF``.
        """
        line = self.take()
        if line.keyword != "EOF":
            raise self.unknown(line, ("EOF",))
        if line.words:
            raise fault(
                "text stands behind EOF on its line",
                line.words[0].place,
                expected="EOF alone on the last line",
                got=quote(line.rest),
                remedy="remove it",
            )
        surplus = next(self._raw_lines(self._last.line), None)
        if surplus is not None:
            raise fault(
                "text stands behind the EOF line",
                surplus.place,
                expected=f"EOF (line {line.place.line}) as the last line",
                got=quote(surplus.keyword),
                remedy="remove the text, or move EOF behind it",
            )

    def unknown(self, line: Line, expected: Iterable[str]) -> ConfigError:
        """Return the error for a line whose keyword is none of the format's."""
        expected = tuple(expected)
        return fault(
            f"unknown keyword {quote(line.keyword)}",
            line.place,
            expected=" or ".join(expected),
            remedy=nearest(line.keyword, expected, self.keywords)
            or _format_of(line.keyword)
            or "correct the keyword or remove the line",
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
        """Yield lines that are neither blank nor comments, behind line `after`."""
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
                word = _WORD.search(content)
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
            "the file holds a control character",
            where=f"{file}:{line}:{at - text.rfind(chr(10), 0, at)}",
            expected="text with spaces, tabs and line ends only",
            got=f"0x{ord(text[at]):02x}",
            remedy="remove it; is it a configuration file at all?",
        )


class Constants:
    """What DEFINE lines said so far."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
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
                got=f"{len(words)} words behind DEFINE",
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
            f"the constant {quote(word.text)} is nested too deep",
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
                remedy="write numbers as in 2.5, -3 or 1e-3",
            )
        name = match[2][:_LONGEST_QUOTE]
        behind = "" if text == word.text else f", which {quote(word.text)} stands for"
        later = re.search(
            rf"^[ \t]*DEFINE[ \t]+{name}(?![^\s])", self._reader.text, re.MULTILINE
        )
        if later:
            line = self._reader.text.count("\n", 0, later.start()) + 1
            remedy = f"move its DEFINE from line {line} above this line"
        else:
            known = [other for other in self._defined if self._known(other, word)]
            remedy = nearest(name, known) or f"add DEFINE {name} above"
        return fault(
            f"the constant {quote(name)} is not defined{behind}",
            word.place,
            expected=f"{wanted}, or a constant that stands for one",
            remedy=remedy,
        )


def _negate(text: str) -> str:
    """Return the text of the number or constant with its sign turned round."""
    if text.startswith("-"):
        return text[1:]
    return "-" + text.removeprefix("+")
