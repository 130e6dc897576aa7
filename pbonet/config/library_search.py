"""Search in a library: by class, port, unit and text (Stewart 1994, section 3.9)."""

from __future__ import annotations

import fnmatch
import re
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from pbonet import pbo
from pbonet.errors import ConfigError, ModuleLoadError, PbonetError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from pbonet.ports import Port

    from .library import Library
    from .model import Rmod

ANY = "any"
"""The unit of a port that takes every variable."""
_DERIVES = re.compile(rb"^class \w+\(.*PortBasedObject", re.MULTILINE)


class Search(Struct, frozen=True, kw_only=True):
    """Conditions of a search; one that is left out does not matter."""

    text: tuple[str, ...] = ()
    """Words, all of which a module's description has; or the name of one module."""
    class_: str = ""
    """Its class in the library, or the beginning of it."""
    in_: str = ""
    """A variable, in which * and ? match any text, that an input is, or is connected to
    by an RMOD, or can be: one of the unit `any` takes every variable that is named
    without * and ?."""
    out: str = ""
    """The same of an output."""
    unit: str = ""
    """The unit of such a port; of any port where none is named."""


class Found(Struct, frozen=True, kw_only=True):
    """A module of a library, and the RMODs that configure it."""

    info: pbo.ModuleInfo
    rmods: tuple[str, ...] = ()
    generic: bool = False
    """Whether it fits because a port of the unit `any` takes every variable."""

    @property
    def name(self) -> str:
        """The module's name."""
        return self.info.name

    @property
    def data(self) -> dict[str, Any]:
        """The fields of the description, ``rmods`` and ``generic``."""
        told = {"rmods": list(self.rmods), "generic": self.generic}
        return {**msgspec.to_builtins(self.info), **told}


def search(
    infos: Iterable[pbo.ModuleInfo], rmods: Mapping[str, Rmod], wanted: Search
) -> list[Found]:
    """Return the modules that fit, sorted by class and name; generic ones come last.

    Args:
        infos: Descriptions of all modules.
        rmods: RMODs by name.
        wanted: What is searched for.

    Raises:
        ModuleLoadError: None fits.
        ConfigError: There is no such class.
    """
    kind = _class(wanted.class_)
    known = list(infos)
    exact = [i for i in known if wanted.text == (i.name,)]
    found: list[Found] = []
    for info in exact or known:
        configured = {n: r for n, r in rmods.items() if r.module == info.name}
        if kind not in {"", info.module_class} or not (
            exact or _has_words(info, configured, wanted.text)
        ):
            continue
        named = _has_ports(info, configured, wanted, generic=False)
        if named or _has_ports(info, configured, wanted, generic=True):
            found.append(
                Found(info=info, rmods=tuple(sorted(configured)), generic=not named)
            )
    if not found and wanted != Search():
        raise _nothing(wanted, [info.name for info in known])
    return sorted(found, key=lambda one: (one.generic, _rank(one.info), one.name))


def _rank(info: pbo.ModuleInfo) -> int:
    classes = pbo.MODULE_CLASSES
    known = info.module_class in classes
    return classes.index(info.module_class) if known else len(classes)


def _class(text: str) -> str:
    """Return the class that, or whose plural, begins with a text.

    Raises:
        ConfigError: None, or more than one, does.
    """
    begun = _classes_from(text)
    if not text or len(begun) == 1:
        return begun[0] if text else ""
    raise ConfigError(
        f"several classes of modules begin with {text}"
        if begun
        else f"there is no class of modules {text}",
        expected=" or ".join(begun or pbo.MODULE_CLASSES),
        remedy="write more of its name" if begun else _near_class(text),
    )


def _classes_from(text: str) -> list[str]:
    """Return the classes that begin with a text, as the name of a folder too."""
    begin = text.lower().replace("_", " ").replace("-", " ")
    return [
        one
        for one in pbo.MODULE_CLASSES
        if one.startswith(begin) or _plural(one).startswith(begin)
    ]


def _plural(name: str) -> str:
    return f"{name.removesuffix('y')}ies" if name.endswith("y") else f"{name}s"


def _near_class(text: str) -> str:
    """Return the hint at a class: of like letters, or that one of the words names."""
    if near := did_you_mean(text.lower(), pbo.MODULE_CLASSES):
        return near
    for word in text.lower().split():
        near = next(iter(_classes_from(word)), "")
        if near or (near := did_you_mean(word, pbo.MODULE_CLASSES)):
            return near if "?" in near else f"did you mean {near}?"
    return "name one of these, or the beginning of it"


def _has_words(
    info: pbo.ModuleInfo, rmods: Mapping[str, Rmod], words: Sequence[str]
) -> bool:
    texts = [info.name, info.doc, info.module_class]
    texts += [f"{name}.rmod" for name in rmods]
    texts += [rmod.desc for rmod in rmods.values()]
    texts += [text for port in info.ports for text in (port.name, port.doc)]
    texts += [text for param in info.params for text in (param.name, param.doc)]
    whole = "\n".join(texts).lower()
    return all(word.lower() in whole for word in words)


def _has_ports(
    info: pbo.ModuleInfo, rmods: Mapping[str, Rmod], wanted: Search, *, generic: bool
) -> bool:
    """Return whether a module has the ports.

    Args:
        info: Its description.
        rmods: Those that configure it.
        wanted: The conditions.
        generic: Whether a port that takes every variable counts for a named one.
    """
    sides = [(wanted.in_, True), (wanted.out, False)]
    asked = [side for side in sides if side[0]]
    if not asked:
        return wanted.unit in {"", *(port.unit for port in info.ports)}
    return all(
        any(
            _is_port(port, name, wanted.unit, rmods)
            or (generic and _takes_every(port, name))
            for port in info.ports
            if port.kind.is_input is reads
        )
        for name, reads in asked
    )


def _is_port(port: Port, name: str, unit: str, rmods: Mapping[str, Rmod]) -> bool:
    """Return whether a port has a unit, and a name that fits."""
    fits = any(fnmatch.fnmatchcase(n, name) for n in _names(port.name, rmods))
    return fits and unit in {"", port.unit}


def _takes_every(port: Port, name: str) -> bool:
    """Return whether a port can be connected to a variable, which has a whole name."""
    return port.unit == ANY and not port.kind.is_const and not set("*?") & set(name)


def _names(port: str, rmods: Mapping[str, Rmod]) -> Iterator[str]:
    """Yield the name of a port, and the variables that RMODs connect it to."""
    yield port
    yield from (rmod.svar_name(port) for rmod in rmods.values())


def _nothing(wanted: Search, known: Sequence[str]) -> ModuleLoadError:
    told = [
        ("", " ".join(wanted.text)),
        ("class ", wanted.class_),
        ("input ", wanted.in_),
        ("output ", wanted.out),
        ("unit ", wanted.unit),
    ]
    return ModuleLoadError(
        "the library has no such module",
        got=", ".join(label + text for label, text in told if text),
        remedy=did_you_mean(wanted.text[0], known)
        if len(wanted.text) == 1 and did_you_mean(wanted.text[0], known)
        else "ask for less; 'library' alone shows them all",
    )


def described(library: Library) -> tuple[list[pbo.ModuleInfo], list[str]]:
    """Return the descriptions of a library's modules, and what does not load.

    The code of all of them runs, so this is for a process of its own, not for a master.

    A file that no RMOD names and that has no class of a module is none, such as a
    program in a project's folder; it is not run.

    Args:
        library: The library.
    """
    rmods = {rmod.module for rmod in library.records().values()}
    infos: list[pbo.ModuleInfo] = []
    faults: list[str] = []
    for name, path in library.files().items():
        try:
            known = name in rmods or path.suffix == ".so"
            if known or _DERIVES.search(path.read_bytes()):
                infos.append(library.load(name).info)
        except (PbonetError, OSError) as error:
            faults.append(str(error))
    return infos, faults


def producers(rmods: Mapping[str, Rmod]) -> dict[str, tuple[str, ...]]:
    """Return, by variable, the RMODs that write it, or give it as a constant."""
    found: dict[str, list[str]] = {}
    for name, rmod in sorted(rmods.items()):
        for port in (*rmod.outvar, *rmod.outconst):
            found.setdefault(rmod.svar_name(port), []).append(name)
    return {variable: tuple(names) for variable, names in found.items()}
