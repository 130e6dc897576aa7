"""The ``.svar`` file: what variables a subsystem's table holds (section 5.5.2)."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

from pbonet.errors import did_you_mean

from . import words
from .blocks import Block, Grammar, read_block
from .lines import Line, Word, fault, quote
from .model import Limit, SvarFile, Variable
from .reader import Reader, load
from .types import MAX_STRUCT, TYPES, ElementType, element_type
from .write import number, same_again, text_line

if TYPE_CHECKING:
    from pathlib import Path

    from .model import Place

MAX_BYTES = 1 << 30
"""Largest variable; beyond it a file surely has a typing error."""

GRAMMAR = Grammar(
    "NAME TYPE DESC UNITS NELEM [INIT] [MIN] [MAX] [MAXAGE|RATE|LIMIT|FINITE]",
    after=("NAME", "EOF"),
)
_STRUCT = re.compile(r"struct\[([^\[\]]+)\]")


def read_svar(path: str | Path) -> SvarFile:
    """Read the ``.svar`` file at `path`.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It says something that cannot be.
    """
    return parse_svar(load(path), str(path))


def parse_svar(text: str | bytes, file: str = "<text>") -> SvarFile:
    """Parse the text of a ``.svar`` file; `file` is its name in messages.

    Raises:
        ConfigError: It says something that cannot be.
    """
    reader = Reader(text, file, GRAMMAR.keywords)
    variables: dict[str, Variable] = {}
    while reader.peek().keyword != "EOF":
        variable = _variable(reader)
        if first := variables.get(variable.name):
            raise fault(
                f"the variable {quote(variable.name)} is defined twice",
                _place(variable),
                expected="one NAME line for each variable",
                got=f"another one in line {_place(first).line}",
                remedy="remove or rename one of them",
            )
        variables[variable.name] = variable
    if not variables:
        raise fault(
            "the file defines no variable",
            reader.peek().place,
            expected="at least one NAME line",
            got="EOF",
            remedy=f"each variable is written {GRAMMAR.text}",
        )
    reader.finish()
    return SvarFile(
        file=file, defines=reader.constants.words, variables=tuple(variables.values())
    )


def _place(variable: Variable) -> Place:
    assert variable.place is not None  # noqa: S101 - set by `_variable`
    return variable.place


def _variable(reader: Reader) -> Variable:
    """Read the block of a variable, which begins at the reader's next line."""
    block = read_block(reader, GRAMMAR)
    name = words.variable(words.single(block["NAME"], "the variable's name"))
    kind = _type(reader, block["TYPE"])
    nelem = _nelem(reader, block["NELEM"], kind)
    finite = _finite(block.get("FINITE"), kind)
    init = _values(reader, block.get("INIT"), kind, nelem, finite=finite)
    low = _values(reader, block.get("MIN"), kind, nelem, finite=False)
    high = _values(reader, block.get("MAX"), kind, nelem, finite=False)
    _check_range(block, low, high, nelem)
    limit = _limit(block, init, low, high, nelem)
    maxage = None
    if line := block.get("MAXAGE"):
        word = words.single(line, "seconds")
        maxage = words.real(reader, word, "seconds above 0")
    rate = None
    if line := block.get("RATE"):
        rate = words.real(reader, words.single(line, "Hz"), "Hz above 0")
    return Variable(
        name=name,
        type=kind.name,
        desc=block["DESC"].rest,
        units=_units(block["UNITS"]),
        nelem=nelem,
        init=init,
        min=low,
        max=high,
        maxage=maxage,
        rate=rate,
        limit=limit,
        finite=finite,
        place=block["NAME"].place,
    )


def _type(reader: Reader, line: Line) -> ElementType:
    word = words.single(line, "one type")
    text = word.text
    if match := _STRUCT.fullmatch(text):
        size = Word(match[1], word.place, "the size of a struct")
        text = f"struct[{words.whole(reader, size, 1, MAX_STRUCT)}]"
    kind = element_type(text)
    if kind is None:
        names = [*TYPES, "struct[xx]"]
        hint = "write the size in bytes" if text.startswith("struct") else ""
        raise fault(
            f"unknown type {quote(text)}",
            word.place,
            expected=" or ".join(names),
            remedy=hint or did_you_mean(text[:20], names) or "write one of these",
        )
    return kind


def _units(line: Line) -> str:
    text = " ".join(word.text for word in line.words)
    if not text:
        raise fault(
            "UNITS needs a unit",
            line.place,
            expected="a unit such as rad/s, or none",
            got="nothing",
            remedy="write UNITS none for a number without unit",
        )
    return text


def _nelem(reader: Reader, line: Line, kind: ElementType) -> int:
    word = words.single(line, "a number of elements")
    return words.whole(reader, word, 1, MAX_BYTES // kind.size)


def _finite(line: Line | None, kind: ElementType) -> bool:
    if line is None:
        return True
    if not kind.is_float:
        raise fault(
            f"FINITE does not apply to the type {kind.name}",
            line.place,
            expected="FINITE for float, double, float32 and float64 only",
            remedy="remove the line",
        )
    return words.yes(line)


def _values(
    reader: Reader,
    line: Line | None,
    kind: ElementType,
    nelem: int,
    *,
    finite: bool,
) -> tuple[float | int, ...] | None:
    """Return the values of an INIT, MIN or MAX line, None without one."""
    if line is None:
        return None
    if kind.is_struct:
        raise fault(
            f"a {kind.name} cannot have {line.keyword}",
            line.place,
            expected=f"no {line.keyword} line, because the table does not know the "
            "contents",
            remedy="remove the line; the task that writes the variable sets it",
        )
    given = line.words
    if not given:
        raise fault(
            f"{line.keyword} has no values",
            line.place,
            expected=f"up to {nelem}" if line.keyword == "INIT" else f"{nelem}",
            got="nothing",
            remedy="write the values on this line, or remove it",
        )
    if len(given) > nelem:
        raise fault(
            f"{line.keyword} has more values than elements",
            given[nelem].place,
            expected=f"at most {nelem}, which is NELEM",
            got=f"{len(given)}",
            remedy="remove the surplus values or correct NELEM",
        )
    if line.keyword != "INIT" and len(given) < nelem:
        raise fault(
            f"{line.keyword} is incomplete",
            line.place,
            expected=f"{nelem} values, which is NELEM",
            got=f"{len(given)}",
            remedy="write one value for each element",
        )
    return tuple(words.element(reader, word, kind, finite=finite) for word in given)


_Values = tuple[float | int, ...] | None


def _check_range(block: Block, low: _Values, high: _Values, nelem: int) -> None:
    """Refuse half a range, and one that holds no value."""
    if (low is None) != (high is None):
        given, other = ("MIN", "MAX") if high is None else ("MAX", "MIN")
        raise fault(
            f"{given} without {other}",
            block[given].place,
            expected="both MIN and MAX, or neither",
            got=f"{given} only",
            remedy=f"add {other} with {nelem} values, or remove {given}",
        )
    for index, (least, most) in enumerate(zip(low or (), high or (), strict=True)):
        if not least <= most:
            word = block["MIN"].words[index]
            raise fault(
                f"element {index} has a MIN above its MAX",
                word.place,
                expected=f"at most {most}, the value of MAX",
                got=f"{least}",
                remedy="exchange the values or correct one",
            )


def _limit(
    block: Block, init: _Values, low: _Values, high: _Values, nelem: int
) -> Limit:
    """Return what happens to values outside the range."""
    line = block.get("LIMIT")
    if line is None:
        return Limit.NONE
    word = words.single(line, "none, clip or error")
    limit = words.choice(word, Limit, "a way to treat values outside MIN and MAX")
    if limit is Limit.NONE:
        return limit
    if low is None or high is None:
        raise fault(
            "LIMIT without MIN and MAX",
            line.place,
            expected="MIN and MAX above LIMIT",
            got="neither",
            remedy="add them, or remove LIMIT",
        )
    for index in range(nelem):
        first = init[index] if init is not None and index < len(init) else 0
        if not math.isnan(first) and not low[index] <= first <= high[index]:
            place = block["INIT"].place if init is not None else line.place
            raise fault(
                f"the initial value of element {index} is outside MIN and MAX",
                place,
                expected=f"{low[index]} to {high[index]}, as LIMIT enforces it",
                got=f"{first}",
                remedy="correct INIT (missing values are 0) or the range",
            )
    return limit


def write_svar(record: SvarFile) -> str:
    """Return the text of a ``.svar`` file with the content of `record`.

    Raises:
        ConfigError: No file can say it, such as a DESC of two lines.
    """
    return same_again(record, svar_text(record), parse_svar)


def svar_text(record: SvarFile) -> str:
    """Return the text of a ``.svar`` file, which may say another thing; see `write`."""
    blocks = ["".join(f"DEFINE {k} {v}\n" for k, v in record.defines.items())]
    blocks += [_written(variable) for variable in record.variables]
    return "\n".join([*(block for block in blocks if block), "EOF\n"])


def _written(variable: Variable) -> str:
    lines = [
        text_line("NAME", variable.name),
        text_line("TYPE", variable.type),
        text_line("DESC", variable.desc),
        text_line("UNITS", variable.units),
        text_line("NELEM", str(variable.nelem)),
    ]
    for keyword in ("init", "min", "max"):
        values: _Values = getattr(variable, keyword)
        if values is not None:
            text = " ".join(number(value) for value in values)
            lines.append(text_line(keyword.upper(), text))
    if variable.maxage is not None:
        lines.append(text_line("MAXAGE", number(variable.maxage)))
    if variable.rate is not None:
        lines.append(text_line("RATE", number(variable.rate)))
    if variable.limit is not Limit.NONE:
        lines.append(text_line("LIMIT", variable.limit.value))
    if not variable.finite:
        lines.append(text_line("FINITE", "no"))
    return "".join(lines)
