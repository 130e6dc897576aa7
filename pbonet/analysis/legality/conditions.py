"""Do the PRE and POST conditions of a job hold? (Stewart 1994, section 3.2).

One walk over the tree does it all: it computes with values, sizes and units at once, so
that a condition is judged before anything runs by the very rules by which it is
evaluated later, only with values that do not matter. Values are Python's own floats:
they are few, and `run` does without numpy.
"""

from __future__ import annotations

import ast
import math
import operator
from functools import lru_cache, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec import Struct

from pbonet.config import Parsed, cost_of, parse
from pbonet.errors import did_you_mean

from .records import Code, Problem
from .units import ANY, conversion, factor, known_unit, same_unit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pbonet.config import Condition, Variable

    Floats = Sequence[float]

_SHOWN = 8
"""Elements of a variable that a refusal shows."""
_SIGNS: dict[type[ast.cmpop], tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}

_TURNED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt,
    ast.Gt: ast.Lt,
    ast.LtE: ast.GtE,
    ast.GtE: ast.LtE,
}
"""The sign when both sides change places."""


class Outcome(Struct, frozen=True):
    """The outcome of a condition."""

    condition: Condition
    holds: bool
    seen: str = ""
    """The comparisons that decided it and the values behind them, as text."""


class Bound(Struct, frozen=True):
    """The least and the greatest number that a condition allows for a term."""

    term: str
    """A part of the condition without spaces, such as ``norm(X-GOAL)``."""
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    """Whether `low` itself is not allowed."""
    open_high: bool = False


class Part(Struct, frozen=True):
    """A part of a condition that must hold for itself."""

    text: str
    """As written, without spaces."""
    bounds: tuple[Bound, ...] = ()
    """The bounds of its terms, if it compares them with numbers; else none."""


class _Quantity(NamedTuple):
    """A number or several, with their unit."""

    values: Floats
    unit: str
    literal: bool = False
    """No variable is in it, so it takes any unit that it has none of itself."""
    truth: bool = False
    """It is yes or no, and no number."""


class _PartError(Exception):
    """A part of a condition has no meaning."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.what)
        self.problem = problem


def check_conditions(
    conditions: Iterable[Condition], variables: Sequence[Variable]
) -> list[Problem]:
    """Return the problems of conditions: unknown variables, sizes, units."""
    table = {variable.name: variable for variable in variables}
    values = {name: [0.0] * one.nelem for name, one in table.items()}
    problems: list[Problem] = []
    for condition in conditions:
        walk = _Walk(parse(condition.text, condition.place), table, values)
        try:
            walk.truth(walk.parsed.tree)
        except _PartError as error:
            problems.append(error.problem)
    return problems


def check_cost(cost: Condition, variables: Sequence[Variable]) -> list[Problem]:
    """Return the problem of a COST line: an unknown variable, a size, a unit."""
    try:
        amounts(cost, variables, {one.name: [0.0] * one.nelem for one in variables})
    except _PartError as error:
        return [error.problem]
    return []


def amounts(
    cost: Condition, variables: Sequence[Variable], values: Mapping[str, Floats]
) -> Floats:
    """Return the numbers at one instant over which a COST line takes its mean.

    Args:
        cost: The line; `check_cost` has found nothing in it.
        variables: What the ``.svar`` file defines.
        values: Those of the variables that it names, all of one instant.
    """
    table = {variable.name: variable for variable in variables}
    _, parsed = _cost_of(cost)
    floats = {name: [*map(float, numbers)] for name, numbers in values.items()}
    return _Walk(parsed, table, floats).numbers(parsed.tree)


_cost_of = lru_cache(maxsize=8)(cost_of)
"""`cost_of`, which is asked for the same line at each instant of a run."""


def evaluate(
    condition: Condition,
    variables: Sequence[Variable],
    values: Mapping[str, Sequence[float]],
    stale: Iterable[str] = (),
) -> Outcome:
    """Return whether a condition holds; `check_conditions` has found nothing in it.

    Args:
        condition: The condition.
        variables: What the ``.svar`` file defines.
        values: Those of the variables that it names, all of one instant.
        stale: Which of them are older than their MAXAGE.

    Returns:
        A condition with a stale variable does not hold, nor one that compares
        infinity or what is no number.
    """
    table = {variable.name: variable for variable in variables}
    parsed = parse(condition.text, condition.place)
    floats = {name: [*map(float, numbers)] for name, numbers in values.items()}
    walk = _Walk(parsed, table, floats)
    holds = walk.truth(parsed.tree)
    old = [name for name in parsed.variables if name in set(stale)]
    told = list(walk.told)
    told += [f"{v} = {_shown(floats[v], table[v])}" for v in parsed.variables]
    told += [f"{v} is older than its MAXAGE, {table[v].maxage:g} s" for v in old]
    return Outcome(condition, holds and walk.finite and not old, "; ".join(told))


def parts(condition: Condition, variables: Sequence[Variable]) -> list[Part]:
    """Return what a condition demands; `check_conditions` has found nothing in it."""
    table = {variable.name: variable for variable in variables}
    values = {name: [1.0] * one.nelem for name, one in table.items()}
    walk = _Walk(parse(condition.text, condition.place), table, values)
    return list(walk.parts(walk.parsed.tree))


def named(conditions: Iterable[Condition]) -> list[str]:
    """Return the variables that conditions name, each once."""
    found = [v for one in conditions for v in parse(one.text, one.place).variables]
    return list(dict.fromkeys(found))


class _Walk:
    """One walk over a condition.

    Args:
        parsed: The condition.
        table: The variables that there are.
        values: Their values, as many as the variable has elements.
    """

    def __init__(
        self,
        parsed: Parsed,
        table: Mapping[str, Variable],
        values: Mapping[str, Floats],
    ) -> None:
        self.parsed = parsed
        self.told: list[str] = []
        """Each comparison with its two numbers."""
        self.finite = True
        """False once a comparison has met NaN or infinity, which answers nothing."""
        self._table = table
        self._values = values

    # -- yes or no --------------------------------------------------------------------

    def truth(self, node: ast.expr) -> bool:
        """Return whether a part holds; all operands are evaluated.

        Raises:
            _PartError: It is no question that has an answer.
        """
        if isinstance(node, ast.BoolOp):
            parts = [self.truth(value) for value in node.values]
            return all(parts) if isinstance(node.op, ast.And) else any(parts)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return not self.truth(node.operand)
        if isinstance(node, ast.Compare):
            return self._compare(node)
        found = self._quantity(node)
        if not found.truth:
            raise self._fault(
                node,
                what="a number is not a condition",
                expected="a comparison, or a variable of TYPE bool",
                got=self.parsed.source(node),
                remedy=f"write such as {self.parsed.source(node)} > 0",
            )
        return bool(self._single(node, found))

    def _compare(self, node: ast.Compare) -> bool:
        nodes = [node.left, *node.comparators]
        found = [self._quantity(one) for one in nodes]
        holds = True
        for at, sign in enumerate(node.ops):
            left, right = self._alike(nodes[at + 1], found[at], found[at + 1])
            one = self._single(nodes[at], left)
            other = self._single(nodes[at + 1], right)
            text, compare = _SIGNS[type(sign)]
            answer = bool(compare(one, other))
            self.finite &= math.isfinite(one) and math.isfinite(other)
            unit = "" if left.unit in {ANY, "none"} else f" {left.unit}"
            if not (left.literal and right.literal):
                word = "holds" if answer else "does not hold"
                self.told.append(f"{one:.6g} {text} {other:.6g}{unit} {word}")
            holds = holds and answer
        return holds

    def parts(self, node: ast.expr) -> Iterator[Part]:
        """Yield the parts that must all hold."""
        if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.And):
            for value in node.values:
                yield from self.parts(value)
        elif isinstance(node, ast.Compare):
            nodes = [node.left, *node.comparators]
            for at, sign in enumerate(node.ops):
                bound = self._bound(nodes[at], type(sign), nodes[at + 1])
                signs = _SIGNS[type(sign)][0]
                text = f"{self._term(nodes[at])}{signs}{self._term(nodes[at + 1])}"
                yield Part(text, (bound,) if bound else ())
        else:
            no = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
            inner = node.operand if isinstance(node, ast.UnaryOp) else node
            term = self._term(inner)
            simple = isinstance(inner, ast.Name | ast.Subscript)
            number = 0.0 if no else 1.0
            bounds = (Bound(term, number, number),) if simple else ()
            yield Part(self._term(node), bounds)

    def _term(self, node: ast.expr) -> str:
        """Return a part's text without spaces, its units at the end."""
        first, end = node.col_offset, node.end_col_offset or 0
        units = [u for at, u in self.parsed.units.items() if first <= at < end]
        return "".join([*self.parsed.source(node).split(), *map("[{}]".format, units)])

    def _bound(
        self, left: ast.expr, sign: type[ast.cmpop], right: ast.expr
    ) -> Bound | None:
        """Return what a comparison says of a term; None if of none, or of two."""
        first, second = self._alike(right, self._quantity(left), self._quantity(right))
        if first.literal == second.literal or sign is ast.NotEq:
            return None
        if first.literal:
            number, term = self._single(left, first), self._term(right)
            sign = _TURNED.get(sign, sign)
        else:
            number, term = self._single(right, second), self._term(left)
        strict = sign in {ast.Lt, ast.Gt}
        if sign is ast.Eq:
            return Bound(term, number, number)
        if sign in {ast.Lt, ast.LtE}:
            return Bound(term, high=number, open_high=strict)
        return Bound(term, low=number, open_low=strict)

    def _single(self, node: ast.expr, found: _Quantity) -> float:
        """Return the only element.

        Raises:
            _PartError: There are several: which is meant?
        """
        if len(found.values) != 1:
            text = self.parsed.source(node)
            raise self._fault(
                node,
                code=Code.SHAPE,
                what="several numbers cannot be compared at once",
                expected="one number",
                got=f"{text}, which has {len(found.values)}",
                remedy=f"write max(abs({text})), norm({text}), or an element of it",
            )
        return float(found.values[0])

    def numbers(self, node: ast.expr) -> Floats:
        """Return the value of an expression that is no condition."""
        return self._number(node).values

    # -- numbers ----------------------------------------------------------------------

    def _quantity(self, node: ast.expr) -> _Quantity:
        if isinstance(node, ast.Constant):
            unit = self.parsed.units.get(node.col_offset, ANY)
            value: Any = node.value
            return _Quantity([float(value)], unit, literal=True)
        if isinstance(node, ast.Name):
            return self._variable(node)
        if isinstance(node, ast.Subscript):
            return self._element(node)
        if isinstance(node, ast.UnaryOp) and not isinstance(node.op, ast.Not):
            found = self._number(node.operand)
            minus = isinstance(node.op, ast.USub)
            return found._replace(values=_times(found, -1.0)) if minus else found
        if isinstance(node, ast.BinOp):
            return self._arithmetic(node)
        if isinstance(node, ast.Call):
            return self._function(node)
        raise self._fault(
            node,
            what="a yes-or-no value is used where a number is expected",
            expected="a number",
            got=self.parsed.source(node),
            remedy="join comparisons with and, or, not",
        )

    def _number(self, node: ast.expr) -> _Quantity:
        return self._quantity(node)._replace(truth=False)

    def _variable(self, node: ast.Name) -> _Quantity:
        name = self.parsed.names[node.col_offset]
        variable = self._table.get(name)
        if variable is None:
            raise self._fault(
                node,
                code=Code.UNKNOWN_VARIABLE,
                what=f"a condition names {name}, which the table does not have",
                expected="a variable of the .svar file",
                got=name,
                remedy=did_you_mean(name, self._table)
                or "correct the name; put comments after # or into DESC",
            )
        if variable.type.startswith("struct"):
            raise self._fault(
                node,
                what=f"a condition cannot read {name}",
                expected="a variable of numbers",
                got=f"TYPE {variable.type}",
                remedy="let its writer put the relevant value into another variable",
            )
        unit = ANY if variable.units == ANY else variable.units
        return _Quantity(self._values[name], unit, truth=variable.type == "bool")

    def _element(self, node: ast.Subscript) -> _Quantity:
        if not isinstance(node.value, ast.Name):  # `parse` lets nothing else through
            raise TypeError(node.value)
        whole = self._variable(node.value)
        size = len(whole.values)
        low, high = _bounds(node.slice, size)
        if not 0 <= low < high <= size:
            raise self._fault(
                node,
                code=Code.SHAPE,
                what="there is no such element",
                expected=f"elements 0 to {size - 1}",
                got=self.parsed.source(node),
                remedy="count from 0; X[0:3] is the first three",
            )
        return whole._replace(values=whole.values[low:high])

    def _arithmetic(self, node: ast.BinOp) -> _Quantity:
        left, right = self._number(node.left), self._number(node.right)
        literal = left.literal and right.literal
        self._must_fit(node.right, left, right)
        if isinstance(node.op, ast.Mult):
            unit = _product(left.unit, right.unit, "*")
            return _Quantity(_each(operator.mul, left, right), unit, literal)
        if isinstance(node.op, ast.Div):
            unit = _product(left.unit, right.unit, "/")
            return _Quantity(_each(_quotient, left, right), unit, literal)
        left, right = self._alike(node.right, left, right)
        sign = operator.add if isinstance(node.op, ast.Add) else operator.sub
        return _Quantity(_each(sign, left, right), left.unit, literal)

    def _function(self, node: ast.Call) -> _Quantity:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        first, *others = [self._number(one) for one in node.args]
        if name == "abs":
            return first._replace(values=[*map(abs, first.values)])
        if name == "norm":
            squares = sum(value * value for value in first.values)
            return first._replace(values=[math.sqrt(squares)])
        choose = _most if name == "max" else _least
        if not others:
            return first._replace(values=[reduce(choose, first.values)])
        for part, other in zip(node.args[1:], others, strict=True):
            self._must_fit(part, first, other)
            left, right = self._alike(part, first, other)
            literal = left.literal and right.literal
            first = _Quantity(_each(choose, left, right), left.unit, literal)
        return first

    # -- what goes together -----------------------------------------------------------

    def _must_fit(self, node: ast.expr, left: _Quantity, right: _Quantity) -> None:
        sizes = {len(left.values), len(right.values)} - {1}
        if len(sizes) > 1:
            raise self._fault(
                node,
                code=Code.SHAPE,
                what="these have different numbers of elements",
                expected=f"{len(left.values)}, or 1",
                got=f"{self.parsed.source(node)}, which has {len(right.values)}",
                remedy="take the elements that belong together, such as X[0:3]",
            )

    def _alike(
        self, node: ast.expr, left: _Quantity, right: _Quantity
    ) -> tuple[_Quantity, _Quantity]:
        """Return two quantities in one unit.

        A number without a unit takes that of the other side; a number with a unit is
        converted. Variables never are: the files say that they are different things.

        Raises:
            _PartError: They have different units.
        """
        if ANY in {left.unit, right.unit} or same_unit(left.unit, right.unit):
            unit = right.unit if left.unit == ANY else left.unit
            return left._replace(unit=unit), right._replace(unit=unit)
        if right.literal and (by := factor(right.unit, left.unit)):
            return left, right._replace(values=_times(right, by), unit=left.unit)
        if left.literal and (by := factor(left.unit, right.unit)):
            return left._replace(values=_times(left, by), unit=right.unit), right
        raise self._fault(
            node,
            code=Code.UNIT,
            what="different units cannot be compared or added",
            expected=left.unit,
            got=f"{self.parsed.source(node)} in {right.unit}",
            remedy=conversion(right.unit, left.unit)
            or "correct UNITS in the .svar file, or the condition",
        )

    def _fault(
        self,
        node: ast.expr,
        *,
        what: str,
        expected: str,
        got: str,
        remedy: str,
        code: Code = Code.CONDITION,
    ) -> _PartError:
        return _PartError(
            Problem(
                code=code,
                what=what,
                where=str(self.parsed.at(node.col_offset)),
                expected=expected,
                got=got,
                remedy=remedy,
                variables=tuple(self.parsed.variables),
            )
        )


def _times(found: _Quantity, by: float) -> Floats:
    return [value * by for value in found.values]


def _each(
    compute: Callable[[float, float], float], left: _Quantity, right: _Quantity
) -> Floats:
    """Return the results element by element; a single number goes with each one."""
    size = max(len(left.values), len(right.values))
    one, other = (
        [*found.values] * size if len(found.values) == 1 else found.values
        for found in (left, right)
    )
    return [*map(compute, one, other)]


def _quotient(one: float, other: float) -> float:
    """Return a quotient; by zero it is infinity or no number, which answer nothing."""
    if other:
        return one / other
    return one * math.copysign(math.inf, other)


def _most(one: float, other: float) -> float:
    """Return the greater number; if either is no number, that."""
    return other if other > one or math.isnan(other) else one


def _least(one: float, other: float) -> float:
    """Return the smaller number; if either is no number, that."""
    return other if other < one or math.isnan(other) else one


def _bounds(node: ast.expr, size: int) -> tuple[int, int]:
    if isinstance(node, ast.Slice):
        low, high = (
            one.value if isinstance(one, ast.Constant) else other
            for one, other in ((node.lower, 0), (node.upper, size))
        )
        return int(str(low)), int(str(high))
    index = int(str(node.value)) if isinstance(node, ast.Constant) else -1
    return index, index + 1


def _product(left: str, right: str, sign: str) -> str:
    """Return the unit of a product or quotient; any if it cannot be determined."""
    units = ["none" if unit == ANY else unit for unit in (left, right)]
    if left == right == ANY or not all(map(known_unit, units)):
        return ANY
    one, other = (
        "1" if unit.strip() in {"none", ""} else f"({unit})" for unit in units
    )
    if other == "1":
        return left if left != ANY else "none"
    if one == "1" and sign == "*":
        return right
    return f"{one}{sign}{other}"


def _shown(values: Floats, variable: Variable) -> str:
    text = " ".join(f"{value:.6g}" for value in values[:_SHOWN])
    text += " ..." if len(values) > _SHOWN else ""
    return text if variable.units in {"none", ""} else f"{text} {variable.units}"
