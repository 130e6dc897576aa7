"""Shapes of numbers and names, and the size of each name."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

from pbonet.errors import PortError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ._port import Port

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def parse_shape(text: str) -> tuple[int | str, ...]:
    """Return the dimensions that `text` names; empty for the scalar ``"1"``.

    Raises:
        ValueError: The text is no shape; the message continues "the shape ...".
    """
    if text.strip() == "1":
        return ()
    dims: list[int | str] = []
    for part in text.split(","):
        word = part.strip()
        if _WORD.fullmatch(word):
            dims.append(word)
        elif word.isascii() and word.isdigit() and int(word) > 0:
            dims.append(int(word))
        else:
            message = f"has a part that is neither a size nor a name: {word!r}"
            raise ValueError(message)
    return tuple(dims)


def shape_text(shape: tuple[int | str, ...]) -> str:
    """Return `shape` in the form of a declaration."""
    return ",".join(str(dim) for dim in shape) or "1"


class _Sizes:
    """The sizes known so far, and where each comes from."""

    def __init__(self, where: str) -> None:
        self._known: dict[str, tuple[int, str]] = {}
        self.where = where

    def __contains__(self, name: str) -> bool:
        return name in self._known

    def __getitem__(self, name: str) -> int:
        return self._known[name][0]

    def origin(self, name: str) -> str:
        """Return where the size of `name` comes from."""
        return self._known[name][1]

    def learn(self, name: str, size: int, origin: str) -> None:
        """Note that `name` is `size`; an earlier, other size is an error."""
        if size < 1:
            raise PortError(
                f"a size cannot be {size}",
                where=self.where,
                expected=f"{name} of at least 1",
                got=f"{size} from {origin}",
                remedy="give the constant its value before this module is created",
            )
        before, who = self._known.setdefault(name, (size, origin))
        if before != size:
            raise PortError(
                f"{who} and {origin} disagree about the size {name}",
                where=self.where,
                expected=f"{before} as {who} has it",
                got=f"{size} from {origin}",
                remedy="give both variables the same NELEM, or connect another one",
            )

    def split(self, shape: tuple[int | str, ...]) -> tuple[int, list[str]]:
        """Return the product of the known dimensions, and the names not yet known."""
        open_names = [d for d in shape if isinstance(d, str) and d not in self]
        known = [
            d if isinstance(d, int) else self[d] for d in shape if d not in open_names
        ]
        return math.prod(known), open_names


def solve_shapes(
    ports: Iterable[Port],
    nelem: Mapping[str, int],
    constants: Mapping[str, int] | None = None,
    *,
    where: str = "",
) -> dict[str, tuple[int, ...]]:
    """Find the size of each name in the ports' shapes.

    Args:
        ports: The ports of one module.
        nelem: Number of elements of the variable of a port, by the port's name. Ports
            that are left out follow from the others.
        constants: Known sizes, by the name in the shape or by the name of the integer
            constant port whose attribute the shape names.
        where: The place that errors name.

    Returns:
        The shape of every port, by attribute; empty tuples for scalars.

    Raises:
        PortError: Two ports disagree, a size does not divide, or one stays unknown.
    """
    ports = list(ports)
    sizes = _Sizes(where)
    _learn_constants(sizes, ports, constants or {})
    open_ports = [port for port in ports if port.name in nelem]
    while open_ports:
        left = [
            port for port in open_ports if not _learn(sizes, port, nelem[port.name])
        ]
        if len(left) == len(open_ports):
            break
        open_ports = left
    return {port.attr: _solved(sizes, port) for port in ports}


def _learn_constants(
    sizes: _Sizes, ports: list[Port], constants: Mapping[str, int]
) -> None:
    used = {dim for port in ports for dim in port.shape if isinstance(dim, str)}
    names = {port.attr: port.name for port in ports if port.kind.is_const}
    for word in sorted(used):
        for known in (word, names.get(word, word)):
            if known in constants:
                sizes.learn(word, int(constants[known]), f"constant {known}")


def _learn(sizes: _Sizes, port: Port, count: int) -> bool:
    """Use the port's element count; False while it cannot be used yet."""
    names = {dim for dim in port.shape if isinstance(dim, str)}
    unknown = {name for name in names if name not in sizes}
    if len(unknown) > 1:
        return False
    about = unknown or (names if len(names) == 1 else set[str]())
    origin = f"port {port.attr} ({port.name})"
    if not about:
        _compare(sizes, port, count, origin)
        return True
    name = about.pop()
    times = port.shape.count(name)
    others = math.prod(
        dim if isinstance(dim, int) else sizes[dim] for dim in port.shape if dim != name
    )
    size = round((count / others) ** (1 / times))
    if others * size**times != count:
        raise PortError(
            f"{origin} cannot have {count} elements",
            where=sizes.where,
            expected=f"a number of elements that fits shape {shape_text(port.shape)}",
            got=f"{count} elements",
            remedy=f"correct NELEM of the variable, or the shape of {port.attr}",
        )
    sizes.learn(name, size, origin)
    return True


def _compare(sizes: _Sizes, port: Port, count: int, origin: str) -> None:
    """Raise unless the port has the number of elements of its known shape."""
    product, _ = sizes.split(port.shape)
    if product != count:
        known = "".join(
            f", {dim} is {sizes[dim]} from {sizes.origin(dim)}"
            for dim in dict.fromkeys(port.shape)
            if isinstance(dim, str)
        )
        raise PortError(
            f"{origin} has another size than its shape declares",
            where=sizes.where,
            expected=f"{_elements(product)} for shape {shape_text(port.shape)}{known}",
            got=_elements(count),
            remedy=f"correct NELEM of the variable, or the shape of {port.attr}",
        )


def _elements(count: int) -> str:
    return "1 element" if count == 1 else f"{count} elements"


def _solved(sizes: _Sizes, port: Port) -> tuple[int, ...]:
    _, names = sizes.split(port.shape)
    if names:
        raise PortError(
            f"the size of port {port.attr} ({port.name}) cannot be known",
            where=sizes.where,
            expected=f"a size for {' and '.join(sorted(set(names)))}",
            remedy="connect a constant that is the size, or a port that has it alone; "
            f"on a bench, say `{names[0]}=...`",
        )
    return tuple(d if isinstance(d, int) else sizes[d] for d in port.shape)
