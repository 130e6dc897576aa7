"""The language of PRE and POST: what must hold of the table's variables (section 3.2).

It is written as in Python, and never run as Python: the text is parsed to a tree in
which only what is listed here may stand. Names of variables may hold ``^ ' .``, and a
number may have a unit, as in ``max(abs(Q_MEZ)) < 5 [deg]``; both are put out of the
parser's way before it begins, without moving anything, so that columns stay true.
"""

from __future__ import annotations

import ast
import re
import warnings
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import ConfigError, did_you_mean

from .lines import fault, quote
from .model import Place

if TYPE_CHECKING:
    from collections.abc import Callable

    from .model import Condition

LONGEST = 500
"""Characters of a condition."""
DEEPEST = 50
"""How many of its parts may be nested."""
FUNCTIONS = {
    "abs": "abs(X)",
    "max": "max(X) or max(X, Y, ...)",
    "min": "min(X) or min(X, Y, ...)",
    "norm": "norm(X)",
}
"""The functions, and how they are called."""
MEANS = {
    "rms": "rms(X), the root of the mean square",
    "mean": "mean(X), the mean of the amounts",
    "peak": "peak(X), the largest amount",
}
"""The means over time that a COST line may have, and how they are written."""

_MEAN = re.compile(r"(?P<name>\w+) *\( *(?P<inner>.*\S) *\)")
_TOKEN = re.compile(
    r"(?P<number>(?:0[xX][0-9a-fA-F]+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?))"
    r"(?P<unit> *\[[^\[\]]*\])?"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_^'.]*)",
    re.ASCII,
)
_WORDS = {"and", "or", "not"}
_NODES = (
    ast.BoolOp, ast.And, ast.Or,
    ast.UnaryOp, ast.Not, ast.USub, ast.UAdd,
    ast.BinOp, ast.Add, ast.Sub, ast.Mult, ast.Div,
    ast.Compare, ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq,
    ast.Call, ast.Subscript, ast.Slice, ast.Name, ast.Constant, ast.Load,
)  # fmt: skip
_KNOWN = "variables, numbers, + - * /, < <= > >= == !=, and or not, " + " ".join(
    FUNCTIONS
)
_REMEDIES: dict[type[ast.AST], str] = {
    ast.Pow: "write the product, X*X",
    ast.Attribute: "the . is part of a name; put a space before it if it is not",
    ast.NamedExpr: "a comparison is ==",
    ast.BitAnd: "write and",
    ast.BitOr: "write or",
    ast.Is: "a comparison is ==",
}


class Parsed(Struct, frozen=True):
    """A well-formed condition; its names are not resolved yet."""

    text: str
    tree: ast.expr
    names: dict[int, str]
    """The variables, by the column (from 0) at which they stand."""
    units: dict[int, str]
    """The units of numbers, by the column of the number."""
    place: Place | None = None

    @property
    def variables(self) -> list[str]:
        """The variables that it names, each once."""
        return list(dict.fromkeys(self.names.values()))

    def source(self, node: ast.expr) -> str:
        """Return a part of the condition's text."""
        return self.text[node.col_offset : node.end_col_offset]

    def at(self, column: int) -> Place:
        """Return the place of a column, from 0."""
        if self.place is None:
            return Place("<text>", 1, column + 1)
        first = self.place
        return Place(first.file, first.line, first.column + column)


def parse(text: str, place: Place | None = None) -> Parsed:
    """Return a condition as a tree.

    Args:
        text: As written.
        place: Where it begins.

    Raises:
        ConfigError: It is no condition; the message has the column.
    """
    blank = Parsed(text, ast.Constant(0), {}, {}, place)
    if len(text) > LONGEST:
        raise fault(
            "the condition is too long",
            blank.at(0),
            expected=f"at most {LONGEST} characters",
            got=f"{len(text)}",
            remedy="write several lines; all of them must hold",
        )
    plain, names, units = _plain(text)
    for column, character in enumerate(plain):
        if not character.isascii() or not character.isprintable():
            raise _wrong(blank, column, f"the character {quote(character)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # such as "1if": the parser's own taste
            tree = ast.parse(plain, mode="eval").body
    except SyntaxError as error:
        column = min(max((error.offset or 1) - 1, 0), len(text))
        raise _wrong(blank, column, _found(text, column)) from None
    except (RecursionError, MemoryError, ValueError):
        raise _wrong(blank, 0, f"more than {DEEPEST} nested parts") from None
    if _depth(tree) > DEEPEST:
        raise _wrong(blank, 0, f"more than {DEEPEST} nested parts")
    found = Parsed(text, tree, names, units, place)
    for node in ast.walk(tree):
        _check(found, node)
    return found


def cost_of(condition: Condition) -> tuple[str, Parsed]:
    """Return the mean of a COST line, and the expression that it is of.

    Raises:
        ConfigError: It is no mean over time, or the expression is malformed.
    """
    text, place = condition.text, condition.place
    match = _MEAN.fullmatch(text)
    if match is None or match["name"] not in MEANS:
        raise fault(
            "COST is malformed",
            place or Place("<text>", 1, 1),
            expected=" or ".join(MEANS.values()),
            got=quote(text),
            remedy=did_you_mean(match["name"] if match else "", MEANS)
            or "write what is to be small as in COST rms(Q_REF - Q_MEZ)",
        )
    begin = match.start("inner")
    inner = place and Place(place.file, place.line, place.column + begin)
    parsed = parse(match["inner"], inner)
    if not parsed.variables:
        raise fault(
            "COST names no variable",
            place or Place("<text>", 1, 1),
            expected="an error of variables of the table",
            got=quote(text),
            remedy="write what is to be small as in COST rms(Q_REF - Q_MEZ)",
        )
    return match["name"], parsed


def replaced(condition: Parsed, value: Callable[[str, Place], str]) -> str:
    """Return its text with every name replaced by `value` of it."""
    text, last = "", 0
    for column, name in sorted(condition.names.items()):
        text += condition.text[last:column] + value(name, condition.at(column))
        last = column + len(name)
    return text + condition.text[last:]


def _plain(text: str) -> tuple[str, dict[int, str], dict[int, str]]:
    """Return the text in a form that the parser can read, and what was replaced."""
    names: dict[int, str] = {}
    units: dict[int, str] = {}
    plain = list(text)
    for match in _TOKEN.finditer(text):
        start, end = match.span()
        if match["unit"]:
            units[start] = match["unit"].strip()[1:-1].strip()
            first = match.start("unit")
            plain[first:end] = " " * (end - first)
        elif (name := match["name"]) and name not in _WORDS:
            if name in FUNCTIONS and text[end:].lstrip().startswith("("):
                continue
            names[start] = name
            plain[start:end] = "_" * (end - start)
    return "".join(plain), names, units


def _depth(tree: ast.AST) -> int:
    """Return how deeply parts are nested."""
    depth, level = 0, [tree]
    while level:
        depth += 1
        level = [below for node in level for below in ast.iter_child_nodes(node)]
    return depth


def _found(text: str, column: int) -> str:
    return quote(text[column:]) if text[column:].strip() else "its end"


def _wrong(
    condition: Parsed, column: int, got: str, expected: str = "", remedy: str = ""
) -> ConfigError:
    return fault(
        "this is not a condition",
        condition.at(column),
        expected=expected or _KNOWN,
        got=f"{got} in {quote(condition.text)}",
        remedy=remedy or "write such as max(abs(Q_REF - Q_MEZ)) < 0.01 and GRIP[0] > 0",
    )


def _check(condition: Parsed, node: ast.AST) -> None:
    """Refuse syntax that is not allowed in a condition.

    Raises:
        ConfigError: This may not.
    """
    if not isinstance(node, _NODES):
        raise _stray(condition, node)
    if isinstance(node, ast.Constant):
        _number(condition, node)
    elif isinstance(node, ast.Call):
        _call(condition, node)
    elif isinstance(node, ast.Subscript):
        _element(condition, node)


def _stray(condition: Parsed, node: ast.AST) -> ConfigError:
    """Return the error for Python syntax that conditions lack."""
    near: ast.AST = node
    if not hasattr(node, "col_offset"):  # an operator: show what it stands in
        near = next(
            (
                one
                for one in ast.walk(condition.tree)
                if node in ast.iter_child_nodes(one)
            ),
            node,
        )
    column: int = getattr(near, "col_offset", 0)
    end: int = getattr(near, "end_col_offset", column + 1)
    return _wrong(
        condition,
        column,
        quote(condition.text[column:end]),
        remedy=_REMEDIES.get(type(node), ""),
    )


def _number(condition: Parsed, node: ast.Constant) -> None:
    value = node.value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            if abs(float(value)) < float("inf"):
                return
        except OverflowError:
            pass
    raise _wrong(
        condition,
        node.col_offset,
        quote(condition.source(node)),
        expected="a finite number",
        remedy="write numbers as in 2.5, -3 or 1e-3",
    )


def _call(condition: Parsed, node: ast.Call) -> None:
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name not in FUNCTIONS or node.keywords:
        word = condition.names.get(node.func.col_offset, "")
        raise _wrong(
            condition,
            node.col_offset,
            quote(condition.source(node)),
            expected="one of " + " ".join(FUNCTIONS),
            remedy=did_you_mean(word, FUNCTIONS) or "a variable's element is X[0]",
        )
    several = name in {"min", "max"}
    if not node.args or (len(node.args) > 1 and not several):
        raise _wrong(
            condition,
            node.col_offset,
            f"{len(node.args)} arguments",
            expected=FUNCTIONS[name],
            remedy="name the variable before it",
        )


def _element(condition: Parsed, node: ast.Subscript) -> None:
    numbers = (
        [node.slice.lower, node.slice.upper]
        if isinstance(node.slice, ast.Slice) and node.slice.step is None
        else [node.slice]
    )
    good = isinstance(node.value, ast.Name) and all(
        one is None or (isinstance(one, ast.Constant) and isinstance(one.value, int))
        for one in numbers
    )
    if not good:
        raise _wrong(
            condition,
            node.col_offset,
            quote(condition.source(node)),
            expected="X[n], or X[n:m] for the elements n to m-1, n and m whole numbers "
            "from 0",
            remedy="only a variable has elements",
        )
