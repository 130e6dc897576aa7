"""Several modules combined into one (Stewart 1994, section 3.8.1): pure data.

The parts of a combination run in their order as one task, with one local table. A
variable that a part writes and the combination does not publish is *inner*: it is
memory that only the parts see.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct, structs

from pbonet.errors import DeclarationError
from pbonet.ports import Kind, Port, Stale

from ._method_names import METHODS
from ._signals import SIGNALS, Signal, SignalInfo

if TYPE_CHECKING:
    from pbonet.errors import PbonetError


class Part(Struct, frozen=True):
    """One part of a combination, with its declarations."""

    name: str
    """The RMOD's name."""
    ports: tuple[Port, ...]
    variables: Mapping[str, str]
    """The variable of each port, by the port's name."""
    methods: tuple[str, ...] = ()
    signals: tuple[SignalInfo, ...] = ()

    def variable(self, port: Port) -> str:
        """Return the variable of a port."""
        return self.variables[port.name]


class Use(NamedTuple):
    """A port of a part, connected to a variable."""

    part: int
    port: Port


class Wire(NamedTuple):
    """One variable within a combination."""

    variable: str
    writers: tuple[Use, ...]
    readers: tuple[Use, ...]

    @property
    def first(self) -> Use:
        """The port that represents the variable outside: its writer's, or the first."""
        return (*self.writers, *self.readers)[0]


class Fault(NamedTuple):
    """Something for which the parts cannot be combined."""

    what: str
    variable: str
    expected: str
    got: str
    remedy: str
    twice: bool = False
    """It has two writers."""

    def error(self, where: str) -> PbonetError:
        """Return it as an error."""
        return DeclarationError(
            self.what,
            where=where,
            expected=self.expected,
            got=self.got,
            remedy=self.remedy,
        )


class Combination(NamedTuple):
    """The interface of a combination."""

    ports: tuple[Port, ...]
    """Named by their variables; each is transferred once, however many parts use it."""
    within: tuple[Port, ...]
    """Ports of the parts that are none of it: inner ones, and more users of one
    variable. They count where sizes are solved."""
    inner: tuple[str, ...]
    """The inner variables."""
    attrs: Mapping[str, str]
    """The attribute of the port of each outer variable."""


def wires(parts: Sequence[Part]) -> dict[str, Wire]:
    """Return the variables that parts use, in the order in which they come up."""
    writers: dict[str, list[Use]] = {}
    readers: dict[str, list[Use]] = {}
    order: dict[str, None] = {}
    for number, part in enumerate(parts):
        for port in part.ports:
            variable = part.variable(port)
            order[variable] = None
            into = readers if port.kind.is_input else writers
            into.setdefault(variable, []).append(Use(number, port))
    return {
        name: Wire(name, tuple(writers.get(name, ())), tuple(readers.get(name, ())))
        for name in order
    }


def faults(parts: Sequence[Part], published: Iterable[str]) -> Iterator[Fault]:
    """Yield for what the parts cannot be combined.

    Args:
        parts: In the order in which they run.
        published: Variables that the combination writes to the table.
    """
    outer = set(published)
    for wire in wires(parts).values():
        name = wire.variable
        if len(wire.writers) > 1:
            both = " and ".join(parts[use.part].name for use in wire.writers)
            yield Fault(
                f"the parts {both} both write {name}",
                name,
                "one writer",
                both,
                "rename the port of one of them by SVARALIAS in its .rmod file; a join "
                "brings two variables together",
                twice=True,
            )
        elif wire.writers:
            yield from _reading(parts, wire, inner=name not in outer)


def _reading(parts: Sequence[Part], wire: Wire, *, inner: bool) -> Iterator[Fault]:
    """Yield the faults of readers of a variable that a part writes."""
    (writer,), name = wire.writers, wire.variable
    by = parts[writer.part].name
    constant = writer.port.kind.is_const
    if inner and writer.port.type == "void[]":
        yield Fault(
            f"{name} is a structure and cannot be an inner variable",
            name,
            "numbers, whose type the modules declare",
            f"{writer.port.kind} {writer.port.name} of part {by}",
            f"list {name} in the combination's {writer.port.kind.name}",
        )
    for use in wire.readers:
        reader = parts[use.part].name
        if use.port.kind.is_const is not constant:
            yield Fault(
                f"{name} is a {use.port.kind} of part {reader} and a "
                f"{writer.port.kind} of part {by}",
                name,
                "both a constant, or both a variable",
                f"{use.port.kind} and {writer.port.kind}",
                "connect one of them to another variable by SVARALIAS",
            )
        elif use.part < writer.part and (inner or constant):
            yield Fault(
                f"part {reader} reads {name} before part {by} writes it",
                name,
                f"{by} before {reader} in COMBINE",
                f"{reader} before {by}",
                "change the order"
                + (
                    ""
                    if constant
                    else f", or list {name} in OUTVAR: then the first cycle finds what "
                    "the table holds, and each other one what the last one wrote"
                ),
            )


def combination(parts: Sequence[Part], published: Iterable[str]) -> Combination:
    """Return the interface of parts that run as one task.

    Unneeded ports are left out: published variables that no part writes.

    Args:
        parts: In the order in which they run.
        published: Variables that the combination writes to the table.
    """
    outer, found = set(published), wires(parts)
    inner = tuple(n for n, wire in found.items() if wire.writers and n not in outer)
    attrs = _attributes(
        parts, [wire for wire in found.values() if wire.variable not in inner]
    )
    words = _Words(parts, found, attrs)
    ports: list[Port] = []
    within: list[Port] = []
    for wire in found.values():
        for use in (*wire.writers, *wire.readers):
            part = parts[use.part]
            same = use is wire.first and wire.variable in attrs
            port = structs.replace(
                use.port,
                name=wire.variable,
                shape=words.shape(use),
                attr=attrs[wire.variable] if same else f"{part.name}.{use.port.attr}",
            )
            (ports if same else within).append(port)
    order = list(Kind)
    ports.sort(key=lambda port: order.index(port.kind))
    aged = ages_through(parts, found, outer)
    whole = tuple(_whole(port, found[port.name], aged) for port in ports)
    return Combination(whole, tuple(within), inner, attrs)


def _whole(port: Port, wire: Wire, aged: Ages) -> Port:
    """Return the port of a combination with the options that its parts give it."""
    if port.kind is Kind.OUTVAR:
        return structs.replace(port, new=port.name not in aged.outputs)
    if port.kind is not Kind.INVAR:
        return port
    limits = [one.port.max_age for one in wire.readers if one.port.max_age is not None]
    actions = [Stale(one.port.stale) for one in wire.readers if one.port.stale]
    return structs.replace(
        port,
        max_age=min(limits, default=None),
        stale=max(actions, key=list(Stale).index) if actions else "",
        feedback=port.name not in aged.inputs,
    )


class Ages(NamedTuple):
    """Variables of a combination through which ages travel."""

    inputs: frozenset[str]
    """Inputs whose age is passed on to a published variable."""
    outputs: frozenset[str]
    """Published variables that inherit the age of an input."""


def ages_through(
    parts: Sequence[Part], found: Mapping[str, Wire], outer: set[str]
) -> Ages:
    """Return how ages travel through a combination: part by part, as its data do."""
    inputs = [name for name, wire in found.items() if not wire.writers]
    reached = {name: _inheriting(parts, found, name) & outer for name in inputs}
    return Ages(
        frozenset(name for name, to in reached.items() if to),
        frozenset[str]().union(*reached.values()),
    )


def _inheriting(
    parts: Sequence[Part], found: Mapping[str, Wire], start: str
) -> set[str]:
    """Return the variables that inherit the age of one, directly or through others."""
    seen: set[str] = set()
    todo = [start]
    while todo:
        for use in found[todo.pop()].readers:
            if use.port.kind is not Kind.INVAR or use.port.feedback:
                continue
            part = parts[use.part]
            for port in part.ports:
                name = part.variable(port)
                if port.kind is Kind.OUTVAR and not port.new and name not in seen:
                    seen.add(name)
                    todo.append(name)
    return seen


def _attributes(parts: Sequence[Part], outer: Sequence[Wire]) -> dict[str, str]:
    """Return an attribute for each outer variable: the part's own where it is free."""
    taken = {*METHODS, "params", "task", "parts"}
    found: dict[str, str] = {}
    for wire in outer:
        use = wire.first
        attr = use.port.attr
        if attr in taken:
            attr = f"{parts[use.part].name.replace('-', '_')}_{attr}"
        while attr in taken:
            attr += "_"
        taken.add(attr)
        found[wire.variable] = attr
    return found


class _Words:
    """One name for each size, whatever its name in the parts.

    Two words are one size if they are the same constant, or are at the same position in
    the shapes of one variable.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        found: Mapping[str, Wire],
        attrs: Mapping[str, str],
    ) -> None:
        self._parents: dict[object, object] = {}
        self._numbers: dict[object, int] = {}
        self._names: dict[object, str] = {}
        for wire in found.values():
            uses = (*wire.writers, *wire.readers)
            for use in uses:
                if use.port.kind.is_const:
                    self._join((use.part, use.port.attr), ("const", wire.variable))
                if len(use.port.shape) == len(uses[0].port.shape):
                    self._join_shapes(uses[0], use)
        for variable, attr in attrs.items():
            self._names.setdefault(self._root(("const", variable)), attr)
        taken = {*attrs.values(), *self._names.values()}
        for number, part in enumerate(parts):
            for word in _words(part):
                root = self._root((number, word))
                if root not in self._names:
                    free = word if word not in taken else f"{part.name}.{word}"
                    self._names[root] = free
                    taken.add(free)

    def shape(self, use: Use) -> tuple[int | str, ...]:
        """Return the shape of a part's port in the words of the combination."""
        return tuple(self._word(use.part, dim) for dim in use.port.shape)

    def _word(self, part: int, dim: int | str) -> int | str:
        if isinstance(dim, int):
            return dim
        root = self._root((part, dim))
        return self._numbers.get(root, self._names[root])

    def _join_shapes(self, one: Use, other: Use) -> None:
        for first, second in zip(one.port.shape, other.port.shape, strict=True):
            if isinstance(first, str) and isinstance(second, str):
                self._join((one.part, first), (other.part, second))
            elif isinstance(first, str) and isinstance(second, int):
                self._numbers[self._root((one.part, first))] = second
            elif isinstance(first, int) and isinstance(second, str):
                self._numbers[self._root((other.part, second))] = first

    def _root(self, key: object) -> object:
        while key in self._parents:
            key = self._parents[key]
        return key

    def _join(self, one: object, other: object) -> None:
        first, second = self._root(one), self._root(other)
        if first != second:
            self._parents[first] = second
            if first in self._numbers:
                self._numbers.setdefault(second, self._numbers[first])


def _words(part: Part) -> dict[str, None]:
    """Return the words in the shapes of a part, in order."""
    return {
        dim: None for port in part.ports for dim in port.shape if isinstance(dim, str)
    }


def methods(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return the methods that any of the parts writes, in the order of `METHODS`."""
    written = {name for part in parts for name in part.methods}
    return tuple(name for name in METHODS if name in written)


def signals(parts: Sequence[Part]) -> tuple[SignalInfo, ...]:
    """Return the parts' own signals; a number that is taken becomes a free one.

    Raises:
        DeclarationError: There are more than the 25 that a task may have.
    """
    found: dict[str, SignalInfo] = {}
    for part in parts:
        for one in part.signals:
            if one.name in found:
                continue
            taken = {other.number for other in found.values()}
            free = (n for n in range(SIGNALS - len(Signal)) if n not in taken)
            number = one.number if one.number not in taken else next(free, None)
            if number is None:
                raise DeclarationError(
                    "the parts have too many user signals",
                    where=part.name,
                    expected=f"at most {SIGNALS - len(Signal)} names",
                    got=f"one more, {one.name}",
                    remedy="run one of the parts as a separate task",
                )
            found[one.name] = structs.replace(one, number=number)
    return tuple(found.values())
