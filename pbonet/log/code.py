"""The files with a module's code: its own, and those it imports from its folder."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

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
    any ``import`` statement names; installed packages are not. A module in C is its
    shared object.
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
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return
    for node in _statements(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            names = [node.module] if node.module else [one.name for one in node.names]
            for name in names:
                yield from _beside(file.parent, name)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from _of_pbonet(node.module)
            for one in node.names:
                yield from _of_pbonet(f"{node.module}.{one.name}")
        elif isinstance(node, ast.Import):
            for one in node.names:
                yield from _of_pbonet(one.name)


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """Yield all statements of a tree; most of its nodes are expressions."""
    for field in _BLOCKS:
        for one in getattr(node, field, ()):
            if isinstance(one, ast.stmt):
                yield one
            yield from _statements(one)


def _beside(folder: Path, name: str) -> Iterator[Path]:
    path = folder.joinpath(*name.split(".")).with_suffix(".py")
    if path.is_file():
        yield path


def _of_pbonet(name: str) -> Iterator[Path]:
    if not any(name == one or name.startswith(f"{one}.") for one in _OURS):
        return
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return
    if spec is not None and spec.origin and spec.origin.endswith(".py"):
        yield Path(spec.origin)
