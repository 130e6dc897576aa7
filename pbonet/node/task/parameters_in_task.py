"""Reading and changing a task's parameters between two cycles."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.pbo import ModuleInfo, ParamInfo, find_param
from pbonet.xm.net import ParamValue

if TYPE_CHECKING:
    from .executor import Executor


def get_params(
    executor: Executor, info: ModuleInfo, name: str | None
) -> list[ParamValue]:
    """Return one parameter as returned by the module's `get`, or all.

    Raises:
        ParameterError: There is no such parameter.
        MethodError: The module's `get` failed.
    """
    names = [about.name for about in info.params] if name is None else [name]
    return [_value(executor, info, one) for one in names]


def set_param(
    executor: Executor, info: ModuleInfo, name: str, value: str
) -> list[ParamValue]:
    """Change a parameter and return its new value.

    Raises:
        ParameterError: There is no such parameter, or the value is refused.
        MethodError: The module's `set` refused it.
    """
    executor.set(name, tuple(value.split()))
    return [_value(executor, info, name)]


def _value(executor: Executor, info: ModuleInfo, name: str) -> ParamValue:
    value = executor.get(name)
    params = executor.instance.params
    field = find_param(params, name)
    about = _about(info, params.__declared__[field].name)
    return ParamValue(
        name=about.name,
        value=value,
        type=about.type,
        unit=about.unit,
        doc=about.doc,
        bounds=about.bounds,
    )


def _about(info: ModuleInfo, name: str) -> ParamInfo:
    return next(about for about in info.params if about.name == name)
