"""Changes the text of a file so that it says another record.

Lines whose meaning stays are kept as they are written, with comments, blank lines,
DEFINE and spacing; the lines of the writers take the place of the others. The result is
read back, and must mean the record.
"""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import msgspec

from pbonet.errors import ConfigError

from .bundle import Section, bundled, split
from .job import job_text, parse_job
from .rmod import parse_rmod, rmod_text
from .seq import parse_seq, write_seq
from .svar import parse_svar, svar_text
from .write import meaning

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from .model import JobFile, Rmod, SeqFile, SvarFile

Record = TypeVar("Record", bound=msgspec.Struct)
Key = tuple[str, ...]
"""A line of a file: its keyword, and the thing that it is about."""

_COMMENT = re.compile(r"[ \t]+#.*")
_LINE = re.compile(r"[ \t]*(?P<keyword>[^ \t\r\n]+)(?P<gap>[ \t]*)(?P<rest>[^\r\n]*)")
_WHOLE = frozenset({"DESC", "SBS", "SVARFILE"})
"""Keywords whose argument is the rest of the line; a ``#`` in it begins no comment."""


_ONCE = frozenset({"SEQUENCE", "DESC", "SBS", "SAFE", "WAIT", "WITHIN"})
"""Keywords of a sequence that it has once."""


class Rewritten(NamedTuple):
    """The text of a file that was changed."""

    text: str
    comments: bool = True
    """Whether the comments of the former text are in it."""


class _Line(NamedTuple):
    """A line with a keyword, and the blank lines and comments above it."""

    key: Key
    above: str
    text: str


def rewrite_job(
    before: str, record: JobFile, renamed: Mapping[str, str] = MappingProxyType({})
) -> Rewritten:
    """Return the text of a ``.job`` file changed so that it says `record`.

    Args:
        before: The text that it has; empty: there is none.
        record: The job; its file is named in messages.
        renamed: New names of tasks, by those that they have in the text: their lines
            keep their places and comments.

    Raises:
        ConfigError: No file can say it.
    """

    def former(last: Key, keyword: str, rest: str) -> Key:
        found = _job_key(last, keyword, rest)
        return tuple(renamed.get(word, word) for word in found)

    return _rewritten(before, record, job_text, parse_job, _job_key, key_before=former)


def rewrite_svar(before: str, record: SvarFile) -> Rewritten:
    """Return the text of a ``.svar`` file changed so that it says `record`.

    Raises:
        ConfigError: No file can say it.
    """
    return _rewritten(before, record, svar_text, parse_svar, _svar_key)


def rewrite_seq(before: str, record: SeqFile) -> Rewritten:
    """Return the text of a ``.seq`` file changed so that it says `record`.

    Raises:
        ConfigError: No file can say it.
    """
    return _rewritten(before, record, write_seq, parse_seq, _seq_key)


def rewrite_rmod(before: str, record: Rmod) -> Rewritten:
    """Return the text of a ``.rmod`` file changed so that it says `record`.

    That of a combination is its own lines alone, without those of its parts.

    Raises:
        ConfigError: No file can say it.
    """
    parts = {part.name: Section(rmod_text(part), part.file) for part in record.parts}

    def parse(text: str, file: str) -> Rmod:
        return parse_rmod(bundled(text, parts.__getitem__), file)

    def write(one: Rmod) -> str:
        return split(rmod_text(one))[0]

    return _rewritten(before, record, write, parse, _rmod_key)


def _rewritten(
    before: str,
    record: Record,
    write: Callable[[Record], str],
    parse: Callable[[str, str], Record],
    key: Callable[[Key, str, str], Key],
    *,
    key_before: Callable[[Key, str, str], Key] | None = None,
) -> Rewritten:
    file = str(getattr(record, "file", ""))
    plain = write(record)
    if meaning(parse(plain, file)) != meaning(record):
        raise ConfigError(
            "the record would mean something else after writing and reading",
            where=file,
            expected="a record as the reader returns it",
            remedy="check texts for line ends, spaces at their ends and #",
        )
    if not before:
        return Rewritten(plain)
    former = parse(before, file)
    if meaning(former) == meaning(record):
        return Rewritten(before)
    there = key_before or key
    text = _merged(
        [*_lines(before, there)],
        [*_lines(write(former), there)],
        [*_lines(plain, key)],
    )
    if "\r\n" in before:
        text = text.replace("\r\n", "\n").replace("\n", "\r\n")
    try:
        if meaning(parse(text, file)) == meaning(record):
            return Rewritten(text)
    except ConfigError:
        pass  # lines of the former text do not go with the new ones
    return Rewritten(plain, comments="#" not in before)


def _lines(text: str, key: Callable[[Key, str, str], Key]) -> Iterator[_Line]:
    """Yield the lines of a text that have a keyword, and EOF as the last."""
    above, last, seen = "", Key(), dict[Key, int]()
    for line in text.splitlines(keepends=True):
        match = _LINE.match(line)
        word = match["keyword"] if match else ""
        if match is None or word.startswith("#") or word == "DEFINE":
            above += line
            continue
        found = ("EOF",) if word == "EOF" else key(last, word, match["rest"])
        number = seen[found] = seen.get(found, 0) + 1
        yield _Line((*found, str(number)), above, line)
        last, above = found, ""
        if word == "EOF":
            return


def _merged(
    before: Iterable[_Line], former: Iterable[_Line], wanted: Iterable[_Line]
) -> str:
    """Return the text `before`, with what is otherwise in `wanted` than in `former`."""
    old = {line.key: line.text for line in former}
    new = {line.key: line for line in wanted}
    kept: list[_Line] = []
    for line in before:
        now = new.get(line.key)
        if (now.text if now else None) == old.get(line.key):
            kept.append(line)
        elif now is not None:
            kept.append(line._replace(text=_in_place_of(line.text, now.text)))
        elif line.above.strip():  # its line goes; comments above it stay
            kept.append(line._replace(text=""))
    there = {line.key for line in kept if line.text}
    at = 0
    for line in new.values():
        if line.key in there:
            at = next(i for i, one in enumerate(kept, 1) if one.key == line.key)
        else:
            kept.insert(at, line)
            at += 1
    return "".join(line.above + line.text for line in kept)


def _in_place_of(before: str, line: str) -> str:
    """Return a new line with the indent, the gap and the comment of the former."""
    was, now = _LINE.match(before), _LINE.match(line)
    if was is None or now is None:
        return line
    keyword = was["keyword"]
    if keyword != now["keyword"]:
        return line
    comment = None if keyword in _WHOLE else _COMMENT.search(was["gap"] + was["rest"])
    begin = before[: was.start("rest")] if was["rest"] else f"{keyword} "
    end = comment[0] if comment else ""
    return f"{begin}{now['rest']}{end.rstrip()}\n"


def _job_key(last: Key, keyword: str, rest: str) -> Key:
    del last
    if keyword == "TASK":
        return (keyword, *rest.split()[:1])
    return (keyword,)


def _seq_key(last: Key, keyword: str, rest: str) -> Key:
    del last
    if keyword in _ONCE:
        return (keyword,)
    said = rest if keyword in {"DONE", "FAIL"} else _COMMENT.sub("", f" {rest}")
    return (keyword, " ".join(said.split()))


def _svar_key(last: Key, keyword: str, rest: str) -> Key:
    before = last[0] if last else ""
    return (rest.partition(" ")[0] if keyword == "NAME" else before, keyword)


def _rmod_key(last: Key, keyword: str, rest: str) -> Key:
    if last[:1] == ("LOCAL",):
        return ("LOCAL", keyword.lower())
    if keyword == "SVARALIAS":
        return (keyword, rest.partition("=")[0].strip())
    return ("FREQ" if keyword == "PERIOD" else keyword,)
