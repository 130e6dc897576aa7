"""Makes an instance of a module, with its ports bound to arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from pbonet.errors import DeclarationError, ParameterError, PortError
from pbonet.ports import SCALARS, Kind, Port, solve_shapes, view

from ._object import PortBasedObject
from ._params import Params

if TYPE_CHECKING:
    from ._combine import Part
    from ._task import TaskContext

M = TypeVar("M", bound=PortBasedObject[Any])

_NUMBERS = {"float": "f8", "int": "i8", "bool": "?"}
"""Types of scalar ports and of the inner variables connected to them."""
_MEMORY = "_port_memory"
"""The instance attribute that holds its `Memory`."""


class Memory(Struct, frozen=True):
    """Values that an instance is bound to."""

    arrays: Mapping[str, NDArray[Any]]
    """The local copy of each port, by attribute, writable."""
    sizes: Mapping[str, int]
    """Value of each constant that is a size of a port, by attribute."""
    shapes: Mapping[str, tuple[int, ...]]
    """Of each port, those within a combination included."""


def memory(instance: PortBasedObject[Any]) -> Memory:
    """Return what `instance` is bound to."""
    found: Memory = vars(instance)[_MEMORY]
    return found


def write_safe(instance: PortBasedObject[Any]) -> Callable[[float], None]:
    """Return a function that writes the safe value of each out-var that has one."""
    arrays = memory(instance).arrays
    values = [
        (array, np.broadcast_to(np.array(port.safe), array.shape).astype(array.dtype))
        for port in type(instance).__interface__.ports
        if port.safe is not None
        for array in (arrays[port.attr],)
    ]

    def write(dt: float) -> None:  # noqa: ARG001 - called in place of `cycle`
        for array, safe in values:
            array[:] = safe

    return write


def check_sizes(instance: PortBasedObject[Any], kind: Kind) -> None:
    """Raise unless the constants that are sizes have the sizes of the ports.

    Args:
        instance: Its constants were just copied in, or set by `init`.
        kind: Which constants to check: in-consts or out-consts.

    Raises:
        PortError: A constant has another value.
    """
    cls = type(instance)
    sizes = memory(instance).sizes
    for port in cls.__interface__.ports:
        if port.kind is not kind or port.attr not in sizes:
            continue
        value, size = int(getattr(instance, port.attr)), sizes[port.attr]
        if value != size:
            named = [p.name for p in cls.__interface__.ports if port.attr in p.shape]
            raise PortError(
                f"{kind} {port.name} is not the size of the ports that it names",
                where=f"{cls.__name__}.{port.attr}",
                expected=f"{size}, as {' and '.join(named)} have",
                got=str(value),
                remedy="correct NELEM in the .svar file; a task that runs must be "
                "killed and spawned again to have another size",
            )


def bind(
    cls: type[M],
    params: Params,
    arrays: Mapping[str, NDArray[Any]],
    task: TaskContext,
    *,
    constants: Mapping[str, int] | None = None,
) -> M:
    """Make an instance of `cls` whose ports are `arrays`; no method is called.

    Args:
        cls: The module's class.
        params: Its parameters, of the class that it declares.
        arrays: The local copy for each port, by attribute: one dimension, at a constant
            address. The instance sees reshaped views of them, read-only ones for
            inputs, and plain numbers for scalars.
        task: The object available as ``self.task``.
        constants: Sizes that are known beforehand, as for `solve_shapes`.

    Raises:
        PortError: An array is missing, too many, or of another type or size.
        ParameterError: `params` is not of the module's class.
        DeclarationError: The class is abstract.
    """
    where = cls.__name__
    if cls.__abstract__:
        raise DeclarationError(
            "an abstract module cannot run",
            where=where,
            remedy="run a class that derives from it",
        )
    if not isinstance(params, cls.__params__):
        raise ParameterError(
            "the parameters are of another class",
            where=where,
            expected=cls.__params__.__name__,
            got=type(params).__name__,
        )
    ports = cls.__interface__.ports
    _check_attrs({port.attr for port in ports}, set(arrays), where)
    nelem = {port.name: arrays[port.attr].size for port in ports}
    shapes = solve_shapes((*ports, *cls.__within__), nelem, constants, where=where)
    instance = object.__new__(cls)
    scalars: dict[str, memoryview] = {}
    bound: dict[str, object] = {
        "params": params,
        "task": task,
        SCALARS: scalars,
        _MEMORY: Memory(arrays, _sizes(ports, shapes), shapes),
    }
    for port in ports:
        _set_value(port, arrays[port.attr], where)
        array = view(port, arrays[port.attr], shapes[port.attr], where=where)
        if port.is_scalar:
            scalars[port.attr] = array.data
        else:
            bound[port.attr] = array
    instance.__dict__.update(bound)
    task.in_vars = frozenset(port.attr for port in ports if port.kind is Kind.INVAR)
    instance.__bound__()
    return instance


def _set_value(port: Port, array: NDArray[Any], where: str) -> None:
    """Write the declared value of an out-const."""
    if port.value is None:
        return
    if len(port.value) not in {1, array.size}:
        raise PortError(
            f"the value of {port.kind} {port.name} has another size",
            where=f"{where}.{port.attr}",
            expected=f"one number, or {array.size}: NELEM of the variable",
            got=f"{len(port.value)} numbers",
            remedy="correct the class or the .svar file",
        )
    array[:] = port.value


def assemble(
    whole: PortBasedObject[Any],
    parts: Sequence[tuple[Part, type[PortBasedObject[Any]]]],
    params: Sequence[Params],
) -> tuple[PortBasedObject[Any], ...]:
    """Return the instances of a combination's parts, on one local table.

    Args:
        whole: The combination, bound. Inner variables get memory of their own; it
            begins with zeros.
        parts: Each part and its class.
        params: The parameters of each.
    """
    cls, bound = type(whole), memory(whole)
    arrays = {port.name: bound.arrays[port.attr] for port in cls.__interface__.ports}
    for port in cls.__within__:
        if port.name not in arrays:
            size = math.prod(bound.shapes[port.attr])
            kind = _NUMBERS.get(port.type) or port.type.removesuffix("[]")
            arrays[port.name] = np.zeros(size, kind)
    return tuple(
        bind(
            made,
            own,
            {port.attr: arrays[part.variable(port)] for port in part.ports},
            part_context(whole, part),
        )
        for (part, made), own in zip(parts, params, strict=True)
    )


def part_context(whole: PortBasedObject[Any], part: Part) -> TaskContext:
    """Return the task of a combination as one of its parts sees it.

    It is the same task: what one sees or sets there, all do. Only the part's in-vars
    and its own signals are its own.
    """
    task, cls = whole.task, type(whole)
    outside = {p.name: p.attr for p in cls.__interface__.ports if p.kind is Kind.INVAR}
    attrs = {port.attr: outside.get(part.variable(port)) for port in part.ports}
    bits = {one.name: one.bit for one in cls.__interface__.signals}
    own = {one.bit: bits[one.name] for one in part.signals}
    kind: Any = type(task)

    def stale(attr: str) -> bool:
        outer = attrs[attr]
        return outer is not None and task.is_stale is not None and task.is_stale(outer)

    def age(attr: str) -> float:
        outer = attrs[attr]
        return 0.0 if outer is None or task.age_of is None else task.age_of(outer)

    def stamp(attr: str) -> int:
        outer = attrs[attr]
        return (
            task.now if outer is None or task.stamp_of is None else task.stamp_of(outer)
        )

    def signal(self: Any, signal: int, text: str = "") -> None:  # noqa: ANN401
        bits = int(signal) & ~sum(own)
        bits |= sum(new for old, new in own.items() if signal & old)
        kind.signal(self, bits, text)

    slots = {
        "__slots__": ("age_of", "in_vars", "is_stale", "stamp_of"),
        "signal": signal,
    }
    made: Any = object.__new__(type("PartContext", (kind,), slots))
    made.__dict__ = vars(task)
    made.is_stale = stale
    made.age_of = age
    made.stamp_of = stamp
    return cast("TaskContext", made)


def _sizes(
    ports: tuple[Port, ...], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, int]:
    """Return the sizes that shapes gave to constants, by the constant's attribute."""
    consts = {port.attr for port in ports if port.kind.is_const}
    return {
        dim: size
        for port in ports
        for dim, size in zip(port.shape, shapes[port.attr], strict=True)
        if isinstance(dim, str) and dim in consts
    }


def _check_attrs(wanted: set[str], got: set[str], where: str) -> None:
    if wanted != got:
        raise PortError(
            "the arrays are not those of the module's ports",
            where=where,
            expected=", ".join(sorted(wanted)) or "none",
            got=", ".join(sorted(got)) or "none",
        )
