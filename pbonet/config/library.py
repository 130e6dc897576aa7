"""The library: where modules and RMODs are found by name (Stewart 1994, section 3.9).

A library is a list of folders with modules, ``NAME.py`` in Python or ``NAME.so`` in C,
and ``.rmod`` files. The folders that a machine's ``agent.toml`` or a command names come
first, then the modules that pbonet brings, then the packages that register under the
entry point group ``pbonet.modules``. A package's modules may stand in folders of it,
one per class. A module is loaded by its name only, never from a path or from text that
came over the network.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import keyword
import os
import stat
import sys
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from pbonet import pbo
from pbonet.errors import (
    ConfigError,
    ConfigFileError,
    ModuleLoadError,
    did_you_mean,
)

from .combining import part_info, published
from .reader import load

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from .bundle import Section
    from .model import Rmod

BUILT_IN = "pbonet.modules"
"""The package of the modules that pbonet brings."""
_COMMON = f"{BUILT_IN}._values"
GROUP = "pbonet.modules"
"""The entry point group of packages with more modules."""


class LoadedModule(Struct, frozen=True):
    """A module that was imported."""

    cls: type[pbo.PortBasedObject[Any]]
    info: pbo.ModuleInfo
    path: Path


class LibraryFolder(Struct, frozen=True):
    """One folder of a library."""

    folder: Path
    package: str
    """The Python package that the folder is, so that modules may import each other's
    subroutines (``from ._values import spread``)."""


class Library:
    """Modules and RMODs by name.

    Args:
        folders: Folders before the modules that pbonet brings and those of installed
            packages; earlier ones win, and all of them win over those. One that does
            not exist is an error when a name is searched for that no other folder has.
    """

    def __init__(self, folders: Iterable[str | Path] = ()) -> None:
        self._named = tuple(Path(folder).expanduser() for folder in folders)
        self.beside: tuple[Path, ...] = ()
        """Folders of an application's files, which are searched before all others."""
        self._loaded: dict[tuple[str, str], LoadedModule] = {}
        self._records: dict[str, Rmod] = {}
        self._stamps: dict[str, int] = {}

    @property
    def folders(self) -> tuple[Path, ...]:
        """The folders that are no packages, in the order in which they are searched."""
        return tuple(dict.fromkeys((*self.beside, *self._named)))

    def _search(self) -> Iterator[LibraryFolder]:
        """Yield the folders; those of installed packages only if all else fails."""
        for folder in self.folders:
            yield LibraryFolder(folder, _package_name(folder))
        yield from built_in()
        yield from self._installed

    @cached_property
    def _installed(self) -> list[LibraryFolder]:
        """The folders of registered packages, which take milliseconds to find."""
        return _registered()

    def load(self, module: str) -> LoadedModule:
        """Run a module's code, unless the same text was run before, and describe it.

        Args:
            module: Its name, as the MODULE line of an RMOD has it.

        Raises:
            ModuleLoadError: There is none, or its code does not load; the message
                names file and line.
            DeclarationError: Its class body is wrong.
        """
        place, path = self._find(_checked(module))
        source = _read(path)
        version = pbo.source_version(source)
        known = self._loaded.get((str(path), version))
        if known is not None:
            return known
        from .module_code import class_of  # most commands run no module

        cls = class_of(path, place.package, source, version)
        info = pbo.describe(cls, name=module, file=str(path), version=version)
        loaded = LoadedModule(cls, info, path)
        self._loaded[str(path), version] = loaded
        return loaded

    def read_rmod(self, path: str | Path) -> Rmod:
        """Read a ``.rmod`` file; parts are beside it or in the library.

        Raises:
            ConfigFileError: It, or a part, cannot be read.
            ConfigError: It says something that cannot be.
        """
        from . import Section, bundled, parse_rmod

        def part(name: str) -> Section:
            beside = Path(path).parent / f"{name}.rmod"
            if beside.is_file():
                return Section(load(beside), str(beside))
            return self.source(name)

        return parse_rmod(bundled(load(path), part), str(path))

    def source(self, name: str, freq: float | None = None) -> Section:
        """Return the text of an RMOD and its file; else that which the class makes.

        Args:
            name: The RMOD, or a module that has no ``.rmod`` file.
            freq: Hz, for a module whose class has none.

        Raises:
            ConfigFileError: There is none of that name.
            ConfigError: The class does not say all.
            ModuleLoadError: The module's code does not load.
        """
        from . import Section, own_rmod

        if self._first_with(f"{name}.rmod") is None and name in self.files():
            loaded = self.load(name)
            return Section(own_rmod(loaded.info, freq), str(loaded.path))
        found = self.find_rmod(name)
        return Section(load(found), str(found))

    def record(self, name: str, freq: float | None = None) -> Rmod:
        """Return an RMOD by its name, or that of a module without a file.

        Raises:
            ConfigError: As `source`, or it says something that cannot be.
            ModuleLoadError: The module's code does not load.
        """
        from . import bundled, parse_rmod

        text, file = self.source(name, freq)
        return parse_rmod(bundled(text, self.source), file)

    def _load_of(self, rmod: Rmod) -> LoadedModule:
        """Return the module of an RMOD; a missing one is reported with its line."""
        try:
            return self.load(rmod.module)
        except ModuleLoadError as error:
            if not error.where and "MODULE" in rmod.places:
                error.where = str(rmod.places["MODULE"])
            raise

    def load_rmod(self, rmod: Rmod) -> LoadedModule:
        """Return the module of an RMOD, or the combination of its parts.

        Raises:
            ModuleLoadError: A module is missing, or its code does not load.
            DeclarationError: A class body is wrong, or the parts cannot be combined.
        """
        if not rmod.parts:
            return self._load_of(rmod)
        loaded = [self.load_rmod(part) for part in rmod.parts]
        told = [
            part_info(part, one.info)
            for part, one in zip(rmod.parts, loaded, strict=True)
        ]
        classes = [
            pbo.PartClass(one.part, had.cls)
            for one, had in zip(told, loaded, strict=True)
        ]
        where = str(rmod.places.get("COMBINE", rmod.file))
        cls = pbo.combine(rmod.name, classes, published(rmod), where=where)
        info = pbo.combined_info(rmod.module, told, published(rmod))
        return LoadedModule(cls, info, Path(rmod.file))

    def find_rmod(self, name: str) -> Path:
        """Return the file of an RMOD.

        Raises:
            ConfigFileError: There is none of that name.
        """
        wanted = name.removesuffix(".rmod")
        located = wanted != Path(wanted).name or wanted in {"", ".", ".."}
        found = None if located else self._first_with(f"{wanted}.rmod")
        if found is not None:
            return found[1]
        raise ConfigFileError(
            f"the library has no RMOD {name}",
            expected=f"{wanted}.rmod in {self._places()}",
            remedy=did_you_mean(wanted, self.rmods()) or self._missing(),
        )

    def modules(self) -> tuple[str, ...]:
        """Return the names of all modules, sorted; no code is run."""
        return tuple(self.files())

    def rmods(self) -> tuple[str, ...]:
        """Return the names of all RMODs, sorted."""
        return tuple(self._files(".rmod"))

    def files(self) -> dict[str, Path]:
        """Return the file of each module by its name, sorted; no code is run."""
        found = self._files(".py")
        for name, path in self._files(".so").items():
            if name not in found and _is_c_module(path):
                found[name] = path
        return {
            name: path
            for name, path in sorted(found.items())
            if not name.startswith(("_", "test_")) and _is_name(name)
        }

    def records(self) -> dict[str, Rmod]:
        """Return all RMODs by name, read again if one has changed.

        One that is wrong is left out; that is reported when it is used.
        """
        entries = self._entries(".rmod")
        stamps = {entry.path: _written(entry) for entry in entries.values()}
        if stamps != self._stamps:
            self._records = {}
            for name, entry in entries.items():
                with contextlib.suppress(ConfigError):
                    self._records[name] = self.read_rmod(Path(entry.path))
            self._stamps = stamps
        return self._records

    def _files(self, ending: str) -> dict[str, Path]:
        """Return the files of an ending by their names, of several the first."""
        return {name: Path(one.path) for name, one in self._entries(ending).items()}

    def _entries(self, ending: str) -> dict[str, os.DirEntry[str]]:
        """Return what folders say of these files; without a `Path` for each file."""
        found: dict[str, os.DirEntry[str]] = {}
        for place in self._search():
            with contextlib.suppress(OSError), os.scandir(place.folder) as entries:
                for entry in entries:
                    name = entry.name.removesuffix(ending)
                    if name and name != entry.name:
                        found.setdefault(name, entry)
        return dict(sorted(found.items()))

    def _first_with(self, *files: str) -> tuple[LibraryFolder, Path] | None:
        """Return the first folder that has one of these files, and its path.

        Raises:
            ModuleLoadError: It has several of them, or may not be searched.
        """
        for place in self._search():
            folder = str(place.folder)  # a `Path` for each file would take most of it
            here = [one for one in files if _is_file(f"{folder}/{one}")]
            found = [place.folder / file for file in here]
            if len(found) > 1:
                raise ModuleLoadError(
                    f"the folder has two modules {found[0].stem}",
                    where=str(place.folder),
                    got=" and ".join(path.name for path in found),
                    remedy="rename one of them, with its .rmod file",
                )
            if found:
                return place, found[0]
        return None

    def _find(self, name: str) -> tuple[LibraryFolder, Path]:
        if found := self._first_with(*_files(name)):
            return found
        raise ModuleLoadError(
            no_module(name),
            expected=f"{name}.py or {name}.so in {self._places()}",
            remedy=self._of_rmod(name)
            or did_you_mean(name, self.modules())
            or self._missing(),
        )

    def _of_rmod(self, name: str) -> str:
        """Return the hint if an RMOD has the name."""
        with contextlib.suppress(ConfigError):
            module = self.read_rmod(self.find_rmod(name)).module
            if module != name:
                return f"{name} is an RMOD of the module {module}; name that one"
        return ""

    def for_agent(self, name: str, rtpu: str) -> str:
        """Return what to do where an agent's library lacks a module.

        Returns:
            Nothing where this library does not have it either.
        """
        found = self._first_with(*_files(name))
        if found is None or found[0].folder not in self.folders:
            return ""
        place = found[0].folder.absolute()
        return (
            f"{found[1].name} is in {place}; the agent {rtpu} needs it, too: "
            f"pbonet agent --name {rtpu} --library {place}"
        )

    def _places(self) -> str:
        """Return the folders that are searched, without those inside others."""
        folders = {one.folder: None for one in self._search()}
        outer = [one for one in folders if one.parent not in folders.keys() - {one}]
        return " or ".join(map(str, outer))

    def _missing(self) -> str:
        """Return the hint about missing folders."""
        gone = [str(folder) for folder in self.folders if not folder.is_dir()]
        if not gone:
            return (
                "write it (`pbonet new module`), or name its folder by --library or "
                "in agent.toml"
            )
        return f"there is no folder {' and no folder '.join(gone)}"


def absent(folders: Iterable[str | Path]) -> list[str]:
    """Return a sentence for each folder of modules that is not there."""
    return [
        f"there is no folder {Path(folder).expanduser().absolute()}, named as a library"
        for folder in folders
        if not Path(folder).expanduser().is_dir()
    ]


def no_module(name: str) -> str:
    """Return the message that a library lacks a module."""
    return f"the library has no module {name}"


def _is_c_module(path: Path) -> bool:
    """Return whether a shared object is a module, by its text; it is not loaded."""
    try:
        return b"pbonet_module" in path.read_bytes()
    except OSError:
        return False


def _files(module: str) -> tuple[str, str]:
    """Return the files that may hold a module: in Python, and in C."""
    return f"{module}.py", f"{module}.so"


def _is_name(name: str) -> bool:
    return name.isidentifier() and name.isascii() and not keyword.iskeyword(name)


def _checked(module: str) -> str:
    """Return a module's name if it is one; it may have come over the network."""
    if not _is_name(module) or module.startswith("_"):
        raise ModuleLoadError(
            "a module is given by name, not by path",
            expected="letters, digits and underscores, no leading underscore",
            got=f'"{module}"',
            remedy="name the folder in agent.toml and the module by its file's name "
            "without .py or .so",
        )
    return module


def _written(entry: os.DirEntry[str]) -> int:
    """Return when a file was written; 0 where it has just been removed."""
    try:
        return entry.stat().st_mtime_ns
    except OSError:
        return 0


def _is_file(path: str) -> bool:
    """Return whether there is a file.

    Raises:
        ModuleLoadError: Its folder may not be searched: another one with a module of
            that name must not be taken for it.
    """
    try:
        return stat.S_ISREG(os.stat(path).st_mode)  # noqa: PTH116
    except PermissionError as error:
        raise ModuleLoadError(
            "a folder of the library may not be searched",
            where=path,
            got=error.strerror or str(error),
            remedy="check its permissions",
        ) from None
    except (OSError, ValueError):
        return False


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ModuleLoadError(
            "the module's file cannot be read",
            where=str(path),
            got=error.strerror or str(error),
            remedy="check its permissions",
        ) from None


@functools.cache
def built_in() -> tuple[LibraryFolder, ...]:
    """Return the folders of the modules that pbonet brings."""
    return tuple(_packaged(BUILT_IN))


def load_common() -> dict[Path, int]:
    """Find the folders of `built_in` and import what most of their modules import.

    Returns:
        When each folder and file that was read was changed, for `forget_common`.
    """
    package = importlib.import_module(BUILT_IN)
    places = [Path(one) for one in package.__path__]
    names = [*places, places[0] / f"{_COMMON.rpartition('.')[2]}.py"]
    read = {one: _changed(one) for one in names}  # first, for it may change meanwhile
    built_in()
    importlib.import_module(_COMMON)
    for name in (f"{pbo.__name__}._describe", f"{__package__}.module_code"):
        importlib.import_module(name)  # loaded by its first use
    return read


def forget_common(read: dict[Path, int]) -> bool:
    """Forget what `load_common` has read if it was changed since; return whether so.

    The next module then reads it again: the text that runs has the hash recorded.
    """
    if all(_changed(one) == then for one, then in read.items()):
        return False
    built_in.cache_clear()
    for name in (_COMMON, BUILT_IN):
        sys.modules.pop(name, None)
    return True


def _changed(path: Path) -> int:
    """Return when a file or folder was changed or put there; 0 if it is not there."""
    try:
        return path.stat().st_ctime_ns
    except OSError:
        return 0


def _packaged(package: str) -> list[LibraryFolder]:
    """Return the folders of an importable package: its own, and those in it."""
    spec = importlib.util.find_spec(package)
    folders = [Path(one) for one in (spec and spec.submodule_search_locations) or ()]
    return [LibraryFolder(folder, package) for folder in folders] + [
        LibraryFolder(inner.parent, f"{package}.{inner.parent.name}")
        for folder in folders
        for inner in sorted(folder.glob("*/__init__.py"))
    ]


def _registered() -> list[LibraryFolder]:
    """Return the folders of the packages that are registered as libraries."""
    from importlib.metadata import entry_points  # it takes as long as all the rest

    found: list[LibraryFolder] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            found += _packaged(point.value)
        except ImportError as error:
            raise ModuleLoadError(
                f"entry point {point.name} names a package that does not import",
                where=point.value,
                got=f"{type(error).__name__}: {error}",
                remedy="install it again, or remove it",
            ) from None
    return found


def _package_name(folder: Path) -> str:
    """Return the name of the package that a plain folder becomes."""
    return f"_pbonet_library_{pbo.source_version(str(folder.absolute()).encode())}"
