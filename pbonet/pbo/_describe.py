"""Description of a module, as data and as text."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
from msgspec import Struct, structs

from pbonet.ports import Kind, Port, is_safe, shape_text

from ._combine import Part, combination, methods, signals
from ._object import ROBOT_INTERFACE, PortBasedObject
from ._signals import SignalInfo

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


OUTPUT_DEVICES = frozenset({"MavLink", "MujocoRobot", "SerialLine", "SimulatedArm"})
"""Classes of `pbonet.io` by which something outside is moved."""


class ParamInfo(Struct, frozen=True, kw_only=True):
    """One parameter of a module."""

    name: str
    type: str
    """In words, such as ``float`` or ``one or more float``."""
    unit: str
    doc: str
    required: bool
    default: str = ""
    """As a LOCAL line would have it."""
    bounds: str = ""
    names: str = ""
    """The kind of thing that its value names, such as ``device``; else empty."""
    count: int = 0
    """As in `Param`: 0 for one plain value, a number of values, or `ANY_COUNT`."""
    low: float | None = None
    """Bound of each value from below, whether or not it is allowed; None: none."""
    high: float | None = None
    """Likewise from above."""


class ModuleInfo(Struct, frozen=True, kw_only=True):
    """Description of a module that needs no run."""

    name: str
    """As the MODULE line of an RMOD names it."""
    cls: str
    doc: str
    """The first paragraph of the class docstring."""
    version: str
    """A hash of the source; see `source_version`."""
    file: str
    ports: tuple[Port, ...]
    params: tuple[ParamInfo, ...]
    methods: tuple[str, ...]
    """Methods that the module writes itself."""
    critical_ok: bool
    """True when it has `stable`, or safe values, and so may be marked CRITICAL."""
    module_class: str = ""
    """Its class in the library, one of `MODULE_CLASSES`; empty: none is declared."""
    robot_interface: bool = False
    """Whether it turns what it reads into motion: it says so by its class, or it has
    none, reads variables, and its code names one of `OUTPUT_DEVICES`."""
    freq: float | None = None
    """Hz of a task without an RMOD; None: the class has none."""
    signals: tuple[SignalInfo, ...] = ()
    """Its own signals (section 4.4.4)."""
    parts: tuple[PartInfo, ...] = ()
    """The parts of a combination, in order (section 3.8.1)."""
    within: tuple[Port, ...] = ()
    """Of a combination: the ports of its parts that are none of it."""

    def named(self, kind: Kind) -> tuple[str, ...]:
        """Return the names of the ports of one kind, as an RMOD lists them."""
        return tuple(port.name for port in self.ports if port.kind is kind)

    @property
    def inner(self) -> tuple[Port, ...]:
        """The writer's port of each inner variable of a combination."""
        own = {port.name for port in self.ports}
        found: dict[str, Port] = {}
        for port in self.within:
            if port.name not in own:
                found.setdefault(port.name, port)
        return tuple(found.values())


class PartInfo(Struct, frozen=True):
    """One part of a combination."""

    name: str
    """The RMOD's name."""
    info: ModuleInfo
    variables: dict[str, str]
    """The variable of each port, by the port's name."""

    @property
    def part(self) -> Part:
        """The part in the form that `combination` uses."""
        info = self.info
        return Part(self.name, info.ports, self.variables, info.methods, info.signals)


def combined_info(
    name: str, parts: Sequence[PartInfo], published: Iterable[str]
) -> ModuleInfo:
    """Return the description of a combination from those of its parts.

    Args:
        name: The name that represents its modules.
        parts: In the order in which they run.
        published: Variables that it writes to the table.

    Raises:
        DeclarationError: The parts have too many signals.
    """
    told = [one.part for one in parts]
    whole = combination(told, published)
    written = methods(told)
    return ModuleInfo(
        name=name,
        cls="Combined",
        doc=f"One task that runs {', then '.join(one.name for one in parts)}.",
        version=source_version(" ".join(one.info.version for one in parts).encode()),
        file="",
        ports=whole.ports,
        params=tuple(
            structs.replace(param, name=f"{one.name}.{param.name}")
            for one in parts
            for param in one.info.params
        ),
        methods=written,
        critical_ok="stable" in written or is_safe(whole.ports),
        module_class=_class_of(parts),
        robot_interface=any(one.info.robot_interface for one in parts),
        signals=signals(told),
        parts=tuple(parts),
        within=whole.within,
    )


def _class_of(parts: Sequence[PartInfo]) -> str:
    """Return the class of a combination; with a robot interface in it, it is one."""
    classes = {one.info.module_class for one in parts}
    if ROBOT_INTERFACE in classes:
        return ROBOT_INTERFACE
    return classes.pop() if len(classes) == 1 else ""


def source_version(source: bytes) -> str:
    """Return the version of a module: the first 12 hex digits of its SHA-256."""
    import hashlib  # brings OpenSSL, which no module needs

    return hashlib.sha256(source).hexdigest()[:12]


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


def local_text(value: Any) -> str:  # noqa: ANN401 - whatever a parameter holds
    """Return a parameter's value as the words of a LOCAL line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple | list):
        values = cast("Sequence[object]", value)
        return " ".join(local_text(one) for one in values)
    return str(value)


def render(info: ModuleInfo) -> str:
    """Return `info` as text for people, without colours."""
    lines = [f"{info.name}: {info.doc}", f"class     {info.module_class or 'none'}", ""]
    ports: list[tuple[str, ...]] = [
        (port.kind, port.name, port.attr, _type(port), port.unit, _about(port))
        for port in info.ports
    ]
    lines += ["ports", *_table(ports or [("none",)]), "", "parameters"]
    params: list[tuple[str, ...]] = [
        (
            param.name,
            param.type,
            param.unit,
            param.bounds,
            "required" if param.required else f"default {param.default}",
            param.doc,
        )
        for param in info.params
    ]
    lines += [*_table(params or [("none",)]), ""]
    if info.signals:
        signals: list[tuple[str, ...]] = [
            (one.name, f"user {one.number}", one.doc) for one in info.signals
        ]
        lines += ["signals", *_table(signals), ""]
    lines.append(f"methods   {' '.join(info.methods)}")
    lacks = "no: has no stable(), and no safe values"
    lines.append(f"CRITICAL  {'possible' if info.critical_ok else lacks}")
    if info.parts:
        lines += ["", "parts"]
        lines += _table([(p.name, p.info.name, p.info.version) for p in info.parts])
        lines += ["", "inner variables"]
        inner: list[tuple[str, ...]] = [
            (port.name, _type(port), port.unit, port.doc) for port in info.inner
        ]
        lines += [*_table(inner or [("none",)]), ""]
    else:
        lines.append(f"code      {info.cls} in {info.file or 'unknown file'}")
    lines.append(f"version   {info.version or 'unknown'}")
    return "\n".join(lines) + "\n"


def _about(port: Port) -> str:
    """Return what a port carries, and what its options say about ages."""
    notes = [
        "" if port.max_age is None else f"at most {port.max_age:g} s old",
        f"else {port.stale}" * bool(port.stale),
        "feedback" * port.feedback,
        "new" * port.new,
        "" if port.safe is None else f"safe {' '.join(map(str, port.safe))}",
        "" if port.value is None else f"value {' '.join(map(str, port.value))}",
    ]
    said = ", ".join(note for note in notes if note)
    return f"{port.doc} ({said})" if said else port.doc


def _type(port: Port) -> str:
    if port.is_scalar:
        return port.type
    return f"{port.type.removesuffix('[]')}[{shape_text(port.shape)}]"


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  "
        + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
