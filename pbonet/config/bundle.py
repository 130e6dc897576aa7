"""A combined RMOD as one text: its own lines, and below EOF the files of its parts.

So it travels, is kept and is read back like any other RMOD. Each part stands below a
line ``PART name file``, in which the file is where it came from, for messages.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import takewhile
from typing import TYPE_CHECKING, NamedTuple

from .lines import WORD

if TYPE_CHECKING:
    from collections.abc import Callable


class Section(NamedTuple):
    """The text of one part, and the file that it is."""

    text: str
    file: str


def split(text: str) -> tuple[str, dict[str, Section]]:
    """Return an RMOD's own text, and those of the parts below it by name.

    Text after EOF that is no part stays in the text, for its reader to refuse.
    """
    chunks = _chunks(text)
    sections: dict[str, Section] = {}
    for chunk in chunks[1:]:
        head, _, body = chunk.partition("\n")
        name, _, file = head.strip(" \t\r").removeprefix("PART").strip().partition(" ")
        sections.setdefault(name, Section(body, file.strip() or f"{name}.rmod"))
    return chunks[0], sections


def bundled(text: str, find: Callable[[str], Section]) -> str:
    """Return the text of an RMOD with the files of all its parts.

    Args:
        text: As its file says it; parts that it holds already stay.
        find: Returns the file of a part.
    """
    main, sections = split(text)
    todo = list(combines(main))
    while todo:
        name = todo.pop(0)
        if name not in sections:
            found = find(name)
            own, below = split(found.text)
            sections = {**below, **sections, name: Section(own, found.file)}
        todo += [more for more in combines(sections[name].text) if more not in sections]
    return "".join([_ended(main), *(_part(*item) for item in sections.items())])


@lru_cache(maxsize=2048)
def combines(text: str) -> tuple[str, ...]:
    """Return what the COMBINE line of an RMOD names; nothing where it has none."""
    for line in text.split("\n"):
        words = _words(line)
        if words and words[0] == "COMBINE":
            return tuple(takewhile(lambda word: not word.startswith("#"), words[1:]))
        if words and words[0] in {"EOF", "LOCAL"}:
            break
    return ()


def _part(name: str, section: Section) -> str:
    return f"PART {name} {section.file}\n{_ended(section.text)}"


def _ended(text: str) -> str:
    return text if not text or text.endswith("\n") else f"{text}\n"


def _chunks(text: str) -> list[str]:
    """Cut a text before each line PART that follows an EOF."""
    chunks: list[str] = []
    begin = at = 0
    over = False
    for line in text.split("\n"):
        words = _words(line)
        if over and words[:1] == ["PART"]:
            chunks.append(text[begin:at])
            begin, over = at, False
        over = over or words[:1] == ["EOF"]
        at += len(line) + 1
    return [*chunks, text[begin:]]


def _words(line: str) -> list[str]:
    return [match[0] for match in WORD.finditer(line.rstrip(" \t\r"))]
