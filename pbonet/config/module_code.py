"""The code of one module: run its file, and return the class that it defines.

What is run is text that `Library` has read, so that its version is that of the text.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import importlib.util
import sys
import threading
import types
from typing import TYPE_CHECKING, Any, TypeGuard

from pbonet import pbo
from pbonet.errors import DeclarationError, ModuleLoadError

if TYPE_CHECKING:
    from pathlib import Path

_VERSION = "__pbonet_version__"
"""The attribute of a Python module that holds the version it was run from."""

_RUNNING = threading.RLock()
"""Held while a module's code runs: another thread must not see it half done."""


def class_of(
    path: Path, package: str, source: bytes, version: str
) -> type[pbo.PortBasedObject[Any]]:
    """Return the class of a module in Python or in C.

    Args:
        path: The module's file.
        package: The Python package that its folder is.
        source: The text of the file.
        version: The version of the text, from `pbo.source_version`.

    Raises:
        ModuleLoadError: Its code does not load; the message names file and line.
        DeclarationError: Its class body is wrong.
    """
    with _RUNNING:
        if path.suffix == ".so":
            from pbonet.cmodule import c_class  # brings numpy

            return c_class(path, source, version)
        return _only_class(_run(path, package, source, version), path.stem, path)


def _run(path: Path, package: str, source: bytes, version: str) -> types.ModuleType:
    """Run a module's code under its qualified name and return what it made.

    A module that this process has imported by itself is taken as it is, so that there
    are not two classes of one name.
    """
    module = path.stem
    if package not in sys.modules:
        _make_package(package, path.parent)
    name = f"{package}.{module}"
    before = sys.modules.get(name)
    if before is not None and getattr(before, _VERSION, version) == version:
        return before
    spec = importlib.machinery.ModuleSpec(name, loader=None, origin=str(path))
    python = importlib.util.module_from_spec(spec)
    python.__file__ = str(path)
    setattr(python, _VERSION, version)
    sys.modules[name] = python
    try:
        code = compile(source, str(path), "exec", dont_inherit=True)
        exec(code, python.__dict__)  # noqa: S102
    except BaseException as error:
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
        if isinstance(error, DeclarationError):
            error.where = f"{path}: {error.where}"
            raise
        if not isinstance(error, Exception | SystemExit):
            raise
        raise _broken(module, path, error) from error
    setattr(sys.modules[package], module, python)  # as `import` does
    return python


def _make_package(name: str, folder: Path) -> None:
    """Make a plain folder a package, so that its files can import each other."""
    if (folder / "__init__.py").exists() and not name.startswith("_pbonet"):
        importlib.import_module(name)
        return
    package = types.ModuleType(name, "A folder of pbonet modules.")
    package.__path__ = [str(folder)]
    sys.modules[name] = package


def _broken(module: str, path: Path, error: BaseException) -> ModuleLoadError:
    """Return the error of a module's code, with its place."""
    line = 0
    if isinstance(error, SyntaxError) and error.filename == str(path):
        line = error.lineno or 0
        text = (error.text or "").strip()
        got = f"{error.msg}: `{text}`" if text else error.msg
    else:
        trace = error.__traceback__
        while trace is not None:
            if trace.tb_frame.f_code.co_filename == str(path):
                line = trace.tb_lineno
            trace = trace.tb_next
        got = f"{type(error).__name__}: {error}"
    return ModuleLoadError(
        f"the code of module {module} does not load",
        where=f"{path}:{line}" if line else str(path),
        got=got,
        remedy=_beside(path, error),
    )


def _beside(path: Path, error: BaseException) -> str:
    """Return what to do; of an import that failed, what it would have found."""
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    if name and (path.parent / f"{name}.py").is_file():
        return f"write `from . import {name}`: the folder is a package"
    if name and not name.startswith(("_pbonet", "pbonet")):
        package = name.partition(".")[0]
        return f"install {package} where pbonet is ({sys.prefix}), or correct the name"
    return "correct it there and try again"


def _is_module(
    value: object, python: types.ModuleType
) -> TypeGuard[type[pbo.PortBasedObject[Any]]]:
    """Return whether `value` is a module class that `python` itself defines."""
    return (
        isinstance(value, type)
        and issubclass(value, pbo.PortBasedObject)
        and value.__module__ == python.__name__
        and not value.__abstract__
    )


def _only_class(
    python: types.ModuleType, module: str, path: Path
) -> type[pbo.PortBasedObject[Any]]:
    """Return the one module class that a file defines."""
    own = [value for value in vars(python).values() if _is_module(value, python)]
    named = [
        cls for cls in own if cls.__name__.lower() == module.replace("_", "").lower()
    ]
    if len(own) == 1 or len(named) == 1:
        return (own if len(own) == 1 else named)[0]
    names = ", ".join(cls.__name__ for cls in own)
    raise ModuleLoadError(
        f"module {module} must define one class that derives from PortBasedObject",
        where=str(path),
        expected="one, or one with the name of the file",
        got=names or "none",
        remedy="put each class into its own file"
        if own
        else "derive its class from pbonet.PortBasedObject",
    )
