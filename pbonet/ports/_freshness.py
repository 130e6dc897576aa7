"""The options of a port, most of them about the age of its values, and their checks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

from ._port import Kind, Stale

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ._port import Port
    from ._source import Declaring

_OPTIONS = {
    Kind.OUTCONST: ("value",),
    Kind.INVAR: ("max_age", "stale", "feedback"),
    Kind.OUTVAR: ("new", "safe"),
}


def options_of(
    body: Declaring,
    port: Port,
    options: dict[str, object],
) -> dict[str, Any]:
    """Return the options of a declaration as fields of its `Port`.

    Raises:
        DeclarationError: One is unknown, or has a value that cannot be.
    """
    attr, kind = port.attr, port.kind
    known = _OPTIONS.get(kind, ())
    found: dict[str, Any] = {}
    for name, value in options.items():
        if name not in known:
            raise body.error(
                attr,
                f"an {kind} has no option {name}",
                expected=" or ".join(known) or "no options",
                got=f"{name}={value!r}",
            )
        if name == "max_age":
            found[name] = _seconds(body, attr, value)
        elif name == "stale":
            found[name] = _action(body, attr, value)
        elif name in {"safe", "value"}:
            found[name] = _numbers(body, port, name, value)
        else:
            found[name] = _flag(body, attr, name, value)
    return found


def check_options(
    body: Declaring, ports: Iterable[Port], methods: Iterable[str]
) -> None:
    """Refuse options of a module's ports that do not fit each other or its methods.

    Raises:
        DeclarationError: They do not.
    """
    ports = tuple(ports)
    outputs = [port for port in ports if port.kind is Kind.OUTVAR]
    new = [port for port in outputs if port.new]
    if new and len(new) < len(outputs):
        other = next(port for port in outputs if not port.new)
        raise body.error(
            new[0].attr,
            f"{new[0].name} is new information and {other.name} is not",
            expected="all out-vars new=True, or none: they are written together and "
            "have one age",
            remedy="mark all of them, or write two modules and combine them",
        )
    for port in ports:
        if lack := lacks(port.stale, ports, methods):
            raise body.error(port.attr, f'stale="{port.stale}" needs {lack}')


def lacks(action: str, ports: Iterable[Port], methods: Iterable[str]) -> str:
    """Return what a module lacks for an action of `Stale`; empty: nothing."""
    if action == Stale.STABLE and "stable" not in methods:
        return "a method stable(self, dt)"
    if action == Stale.SAFE:
        outputs = [port for port in ports if port.kind is Kind.OUTVAR]
        lacking = [port.name for port in outputs if port.safe is None]
        if lacking:
            return f"a safe value of {' and '.join(lacking)}: OutVar(..., safe=0.0)"
    return ""


def is_safe(ports: Iterable[Port]) -> bool:
    """Return whether a module has out-vars, each with a safe value."""
    outputs = [port for port in ports if port.kind is Kind.OUTVAR]
    return bool(outputs) and all(port.safe is not None for port in outputs)


def _seconds(body: Declaring, attr: str, value: object) -> float | None:
    if value is None:
        return None
    if isinstance(value, int | float) and not isinstance(value, bool):
        seconds = float(value)
        if 0 < seconds < math.inf:
            return seconds
    raise body.error(
        attr,
        "max_age is no time",
        expected="seconds above 0",
        got=repr(value),
    )


def _action(body: Declaring, attr: str, value: object) -> str:
    if value == "" or value in list(Stale):
        return str(value)
    raise body.error(
        attr,
        "stale is no action",
        expected=" or ".join(f'"{one}"' for one in Stale),
        got=repr(value),
    )


def _flag(body: Declaring, attr: str, name: str, value: object) -> bool:
    if isinstance(value, bool):
        return value
    raise body.error(attr, f"{name} is no bool", expected="True", got=repr(value))


def _numbers(
    body: Declaring, port: Port, name: str, value: object
) -> tuple[float, ...] | None:
    """Return values for a port: one for all elements, or one for each."""
    if value is None:
        return None
    single = isinstance(value, int | float)
    numbers = [value] if single else _items(value)
    size = _size(port.shape)
    fits = bool(numbers) and (single or size in {0, len(numbers)})
    structure = port.type.startswith("void")
    if fits and not structure and all(_is_number(one, port.type) for one in numbers):
        found = cast("list[float]", numbers)
        return tuple(int(one) if isinstance(one, bool) else one for one in found)
    raise body.error(
        port.attr,
        f"{name} is no value of the port",
        expected="none for a structure"
        if structure
        else f"{_expected(port.type)}, or one for each element",
        got=repr(value),
    )


def _items(value: Any) -> list[Any]:  # noqa: ANN401 - whatever was declared
    if isinstance(value, str) or not isinstance(value, Sequence):
        return []
    return list(value)  # pyright: ignore[reportUnknownArgumentType]


def _size(shape: tuple[int | str, ...]) -> int:
    """Return the number of elements; 0 while a size is a name."""
    return math.prod(one if isinstance(one, int) else 0 for one in shape)


def _expected(kind: str) -> str:
    """Return in words what a number of a port's type is."""
    if kind.startswith("bool"):
        return "True or False"
    if "int" not in kind:
        return "a finite number"
    low, high = _range(kind)
    return f"a whole number from {low} to {high}"


def _range(kind: str) -> tuple[int, int]:
    """Return the least and the greatest number of a type of whole numbers."""
    name = kind.removesuffix("[]")
    bits = int(name.lstrip("uint") or 64)
    if name.startswith("u"):
        return 0, 2**bits - 1
    return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


def _is_number(value: object, kind: str) -> bool:
    """Return whether a value is one that a port's type can hold."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return False
    if kind.startswith("bool"):
        return value in {0, 1}
    if "int" not in kind:
        return True
    low, high = _range(kind)
    return float(value).is_integer() and low <= value <= high
