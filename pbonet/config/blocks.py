"""The order of keywords in a block, and those that may be left out.

A grammar is written as it is shown to people: ``NAME TYPE [INIT] PRE* TASK+``.
``[A|B]`` are optional keywords in any order, ``A|B`` at least one of them, ``*`` any
number of lines, ``+`` one or more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .lines import Line, fault
from .model import Place
from .reader import Reader

if TYPE_CHECKING:
    from pbonet.errors import ConfigError


class Stage:
    """One place in the order: the keywords that may stand there."""

    def __init__(self, text: str) -> None:
        self.many = text[-1] in "*+"
        self.optional = text[0] == "[" or text[-1] == "*"
        self.text = text.strip("[]*+")
        self.keywords = tuple(self.text.split("|"))


class Grammar:
    """The order of a block's keywords.

    Args:
        text: The order as people read it.
        after: Keywords that may follow the block.
        either: Groups of keywords of which only one may be given; the reader of the
            block refuses two, here they are not offered.
    """

    def __init__(
        self,
        text: str,
        *,
        after: tuple[str, ...] = ("EOF",),
        either: tuple[tuple[str, ...], ...] = (),
    ) -> None:
        self.text = text
        self.after = after
        self.either = either
        self.stages = [Stage(part) for part in text.split()]
        self.stage_of = {
            keyword: number
            for number, stage in enumerate(self.stages)
            for keyword in stage.keywords
        }

    @property
    def keywords(self) -> tuple[str, ...]:
        """All keywords, in order."""
        return tuple(self.stage_of)

    def next_after(self, number: int, found: Block) -> list[str]:
        """Return the keywords that may follow stage `number`."""
        words: list[str] = []
        had = set(found.lines)
        for group in self.either:
            if not had.isdisjoint(group):
                had.update(group)
        for index, stage in enumerate(self.stages[max(number, 0) :], max(number, 0)):
            missing = [k for k in stage.keywords if k not in had]
            words += stage.keywords if stage.many else missing
            if index > number and not stage.optional:
                return words
        return words + [word for word in self.after if word not in words]


class Block:
    """The lines of one block, by keyword."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.lines: dict[str, list[Line]] = {}

    def __contains__(self, keyword: str) -> bool:
        """Return whether the block has a line of that keyword."""
        return keyword in self.lines

    def __getitem__(self, keyword: str) -> Line:
        """Return the first line of that keyword."""
        return self.lines[keyword][0]

    def get(self, keyword: str) -> Line | None:
        """Return the line of that keyword, None when the block has none."""
        lines = self.lines.get(keyword)
        return lines[0] if lines else None

    def all(self, keyword: str) -> list[Line]:
        """Return every line of that keyword."""
        return self.lines.get(keyword, [])

    @property
    def places(self) -> dict[str, Place]:
        """The first place of each keyword."""
        return {keyword: lines[0].place for keyword, lines in self.lines.items()}


def read_block(reader: Reader, grammar: Grammar) -> Block:
    """Return the block that begins at the reader's next line.

    Raises:
        ConfigError: A keyword is unknown, missing, repeated, or out of order.
    """
    block = Block(reader.peek().place)
    stage = -1
    while True:
        line = reader.peek()
        if line.keyword in grammar.after and not _belongs(line, grammar, block):
            _refuse_missing(reader, grammar, (stage, len(grammar.stages)), line)
            return block
        number = grammar.stage_of.get(line.keyword)
        if number is None:
            raise _foreign(reader, line, grammar, grammar.next_after(stage, block))
        if number < stage or (
            line.keyword in block and not grammar.stages[number].many
        ):
            raise _late(line, grammar, block, stage)
        _refuse_missing(reader, grammar, (stage, number), line)
        stage = number
        block.lines.setdefault(line.keyword, []).append(reader.take())


def _belongs(line: Line, grammar: Grammar, block: Block) -> bool:
    """Return whether a keyword that may begin the next block still is of this one."""
    return line.keyword in grammar.stage_of and not block.lines


def _foreign(
    reader: Reader, line: Line, grammar: Grammar, expected: list[str]
) -> ConfigError:
    """Return the error for a keyword that this block does not have."""
    if line.keyword not in reader.keywords:
        return reader.unknown(line, expected)
    return fault(
        f"{line.keyword} is not allowed here",
        line.place,
        expected=" or ".join(expected),
        remedy=f"the order is {grammar.text}, then {' or '.join(grammar.after)}",
    )


def _late(line: Line, grammar: Grammar, block: Block, stage: int) -> ConfigError:
    """Return the error for a keyword that was given already or comes too late."""
    first = block.get(line.keyword)
    if first and not grammar.stages[grammar.stage_of[line.keyword]].many:
        return fault(
            f"{line.keyword} is given twice",
            line.place,
            expected=f"one {line.keyword} line",
            got=f"another one in line {first.place.line}",
            remedy="remove one of them",
        )
    former = next(k for k in grammar.stages[stage].keywords if k in block)
    return fault(
        f"wrong order: {line.keyword} follows {former}",
        line.place,
        expected=f"{line.keyword} before {former}",
        remedy=f"the order is {grammar.text}",
    )


def _refuse_missing(
    reader: Reader, grammar: Grammar, between: tuple[int, int], line: Line
) -> None:
    """Refuse `line` when a required keyword between two stages has not come yet."""
    first, end = between
    for needed in grammar.stages[first + 1 : end]:
        if not needed.optional:
            wanted = needed.text.replace("|", " or ")
            late = _follows(reader, grammar, needed, line)
            raise fault(
                f"wrong order: {line.keyword} is where {wanted} must be"
                if late
                else f"the line {wanted} is missing",
                line.place,
                expected=wanted,
                got=line.keyword,
                remedy=f"the order is {grammar.text}"
                if late
                else f"write it before this line; the order is {grammar.text}",
            )


def _follows(reader: Reader, grammar: Grammar, needed: Stage, line: Line) -> bool:
    """Return whether a keyword of `needed` follows `line` in the same block."""
    if line.keyword in grammar.after:
        return False
    for later in reader.after(line):
        if later.keyword in grammar.after:
            return False
        if later.keyword in needed.keywords:
            return True
    return False
