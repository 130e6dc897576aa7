"""Makes an instance of a module, with its ports bound to arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec import Struct
from numpy.typing import NDArray

from pbonet.errors import DeclarationError, ParameterError, PortError
from pbonet.ports import SCALARS, Kind, Port, solve_shapes, view

from ._object import PortBasedObject
from ._params import Params

if TYPE_CHECKING:
    from ._task import TaskContext

M = TypeVar("M", bound=PortBasedObject[Any])

_MEMORY = "_port_memory"
"""The instance attribute that holds its `Memory`."""


class Memory(Struct, frozen=True):
    """What an instance is bound to."""

    arrays: Mapping[str, NDArray[Any]]
    """The local copy behind each port, by attribute, writable."""
    sizes: Mapping[str, int]
    """What each constant that is a size of a port must be, by attribute."""


def memory(instance: PortBasedObject[Any]) -> Memory:
    """Return what `instance` is bound to."""
    found: Memory = vars(instance)[_MEMORY]
    return found


def check_sizes(instance: PortBasedObject[Any], kind: Kind) -> None:
    """Raise unless the constants that are sizes have the sizes of the ports.

    Args:
        instance: Its constants were just copied in, or set by `init`.
        kind: Which of them are looked at: in-consts or out-consts.

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
        arrays: The local copy behind each port, by attribute: one dimension, at an
            address that stays for life. The instance sees reshaped views of them,
            read-only ones for inputs, and plain numbers for scalars.
        task: What the module sees as ``self.task``.
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
    shapes = solve_shapes(ports, nelem, constants, where=where)
    instance = object.__new__(cls)
    scalars: dict[str, memoryview] = {}
    bound: dict[str, object] = {
        "params": params,
        "task": task,
        SCALARS: scalars,
        _MEMORY: Memory(arrays, _sizes(ports, shapes)),
    }
    for port in ports:
        array = view(port, arrays[port.attr], shapes[port.attr], where=where)
        if port.is_scalar:
            scalars[port.attr] = array.data
        else:
            bound[port.attr] = array
    instance.__dict__.update(bound)
    task.in_vars = frozenset(port.attr for port in ports if port.kind is Kind.INVAR)
    return instance


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
