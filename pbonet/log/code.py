"""The files with a module's code: its own, and those it imports from its folder."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.lazy import homes

from .records import CodeFile

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

_OURS = ("pbonet.modules", "pbonet.io")
"""Packages of pbonet that count as a module's code; the rest is the runtime."""

_BLOCKS = ("body", "orelse", "handlers", "finalbody", "cases")
"""Fields of a node that hold statements, or what holds statements."""


def code_of(paths: Iterable[str | Path]) -> list[CodeFile]:
    """Return the files with modules' code, their own first, with their hashes.

    Included are files of the module's folder and of pbonet's library and devices that
    any ``import`` statement names, and of native ones their sources; installed packages
    are not. A module in C is its shared object.
    """
    found: dict[Path, CodeFile] = {}
    waiting = [Path(path) for path in paths]
    while waiting:
        file = waiting.pop(0)
        if file in found:
            continue
        try:
            source = file.read_bytes()
        except OSError:
            continue
        found[file] = CodeFile(str(file), hashlib.sha256(source).hexdigest())
        waiting += _imported(file, source)
    return list(found.values())


def _imported(file: Path, source: bytes) -> Iterator[Path]:
    if file.suffix != ".py":
        return
    for module, names, relative in _imports(source):
        if relative:
            for name in [module] if module else names:
                yield from _beside(file.parent, name)
            continue
        yield from _of_pbonet(module)
        for name in names:
            yield from _of_pbonet(f"{module}.{name}")


@functools.lru_cache(256)
def _imports(source: bytes) -> tuple[tuple[str, tuple[str, ...], bool], ...]:
    """Return what the statements of a file import: module, names, and if beside it."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return ()
    found: list[tuple[str, tuple[str, ...], bool]] = []
    for node in _statements(tree):
        if isinstance(node, ast.ImportFrom) and (node.level == 1 or node.module):
            names = tuple(one.name for one in node.names)
            found.append((node.module or "", names, node.level == 1))
        elif isinstance(node, ast.Import):
            found += [(one.name, (), False) for one in node.names]
    return tuple(found)


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """Yield all statements of a tree; most of its nodes are expressions."""
    for field in _BLOCKS:
        for one in getattr(node, field, ()):
            if isinstance(one, ast.stmt):
                yield one
            yield from _statements(one)


def _beside(folder: Path, name: str) -> Iterator[Path]:
    path = folder.joinpath(*name.split("."))
    for file in (path.with_suffix(".py"), path.with_suffix(".pyx")):
        if file.is_file():
            yield file


def _of_pbonet(name: str) -> Iterator[Path]:
    if not any(name == one or name.startswith(f"{one}.") for one in _OURS):
        return
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return
    if spec is None:
        yield from _offered(*name.rpartition(".")[::2])
    elif spec.origin and spec.origin.endswith(".py"):
        yield Path(spec.origin)
    elif spec.origin:
        yield from _beside(Path(spec.origin).parent, name.rpartition(".")[2])


def _offered(package: str, name: str) -> Iterator[Path]:
    """Yield the file from which a package takes a name that it offers."""
    spec = importlib.util.find_spec(package)
    face = Path(spec.origin) if spec is not None and spec.origin else Path()
    if face.name == "__init__.py" and face.with_suffix(".pyi").is_file():
        home = homes(str(face)).get(name, ".")
        if home != ".":
            yield from _of_pbonet(importlib.util.resolve_name(home, package))
