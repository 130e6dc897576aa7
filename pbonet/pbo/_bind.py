"""Makes an instance of a module, with its ports bound to arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from pbonet.errors import DeclarationError, ParameterError, PortError
from pbonet.ports import SCALARS, solve_shapes, view

from ._object import PortBasedObject
from ._params import Params

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from ._task import TaskContext

M = TypeVar("M", bound=PortBasedObject[Any])


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
        raise DeclarationError("an abstract module cannot run", where=where)
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
    }
    for port in ports:
        array = view(port, arrays[port.attr], shapes[port.attr], where=where)
        if port.is_scalar:
            scalars[port.attr] = array.data
        else:
            bound[port.attr] = array
    instance.__dict__.update(bound)
    return instance


def _check_attrs(wanted: set[str], got: set[str], where: str) -> None:
    if wanted != got:
        raise PortError(
            "the arrays are not those of the module's ports",
            where=where,
            expected=", ".join(sorted(wanted)) or "none",
            got=", ".join(sorted(got)) or "none",
        )
