"""Descriptions of modules, as data and as text; no module is run for them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from msgspec import Struct, structs

from pbonet.ports import Kind, Port, is_safe, shape_text

from ._combine import Part, combination, methods, signals
from ._method_names import ROBOT_INTERFACE
from ._signals import SignalInfo

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


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
