"""Describes a module by its class."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import msgspec
from msgspec import structs

from pbonet.ports import Kind, is_safe

from ._method_names import ROBOT_INTERFACE
from ._module_info import ModuleInfo, ParamInfo, local_text, source_version
from ._object import PortBasedObject

OUTPUT_DEVICES = frozenset({"MavLink", "MujocoRobot", "SerialLine", "SimulatedArm"})
"""Classes of `pbonet.io` by which something outside is moved."""


def describe(
    cls: type[PortBasedObject[Any]],
    *,
    name: str = "",
    file: str = "",
    version: str = "",
) -> ModuleInfo:
    """Return the description of a module.

    Args:
        cls: The module's class.
        name: Its name in RMODs; by default that of its Python module.
        file: Its file; found from the class by default.
        version: Hash of the source that was run; computed from the file by default.
    """
    file = file or _file(cls)
    if not version and file and Path(file).is_file():
        version = source_version(Path(file).read_bytes())
    declared = cls.__interface__
    return ModuleInfo(
        name=name or cls.__module__.rpartition(".")[2],
        cls=cls.__qualname__,
        doc=" ".join(_doc(cls).split("\n\n")[0].split()),
        version=version,
        file=file,
        ports=declared.ports,
        params=_params(cls),
        methods=declared.methods,
        critical_ok="stable" in declared.methods or is_safe(declared.ports),
        module_class=cls.module_class,
        robot_interface=_is_robot_interface(cls),
        freq=cls.__freq__,
        signals=declared.signals,
    )


def _doc(cls: type) -> str:
    """Return the docstring of a class or of a module that it derives from.

    That of `PortBasedObject` says nothing about the module.
    """
    before = cls.__mro__[: cls.__mro__.index(PortBasedObject)]
    texts = (vars(one).get("__doc__") for one in before)
    return inspect.cleandoc(next((text for text in texts if text is not None), ""))


def _is_robot_interface(cls: type[PortBasedObject[Any]]) -> bool:
    if cls.module_class:
        return cls.module_class == ROBOT_INTERFACE
    reads = any(port.kind is Kind.INVAR for port in cls.__interface__.ports)
    return reads and any(map(_names_device, cls.__mro__))


def _names_device(cls: type) -> bool:
    """Return whether a class, or the top level of its file, names an output device.

    A driver in another file, or that is not of `pbonet.io`, is not seen.
    """
    python = sys.modules.get(cls.__module__)
    codes = [getattr(value, "__code__", None) for value in vars(cls).values()]
    return any(map(_is_device, vars(python).values() if python else ())) or any(
        not OUTPUT_DEVICES.isdisjoint(code.co_names) for code in codes if code
    )


def _is_device(value: object) -> bool:
    return (
        isinstance(value, type)
        and value.__name__ in OUTPUT_DEVICES
        and value.__module__.startswith("pbonet.io.")
    )


def _file(cls: type) -> str:
    try:
        return inspect.getsourcefile(cls) or ""
    except (OSError, TypeError):
        return ""


def _params(cls: type[PortBasedObject[Any]]) -> tuple[ParamInfo, ...]:
    kind = cls.__params__
    fields = {field.name: field for field in structs.fields(kind)}
    found: list[ParamInfo] = []
    for name, about in kind.__declared__.items():
        default = fields[name].default
        required = default is msgspec.NODEFAULT
        found.append(
            ParamInfo(
                name=about.name,
                type=about.type_text,
                unit=about.unit,
                doc=about.doc,
                required=required,
                default="" if required else local_text(default),
                bounds=about.bounds,
                names=about.names,
                count=about.count,
                low=max(_declared(about.ge, about.gt), default=None),
                high=min(_declared(about.le, about.lt), default=None),
            )
        )
    return tuple(found)


def _declared(*bounds: float | None) -> list[float]:
    """Return the bounds that are declared."""
    return [bound for bound in bounds if bound is not None]
