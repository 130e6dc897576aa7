"""Packages whose names are imported when they are first used.

Each package lists the names that other packages may use in its ``__init__.pyi``,
where type checkers find them. Its ``__init__.py`` calls `attach`, which reads the same
list. So importing a package costs little, and each verb, agent and task loads only what
it uses.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import logging
    from collections.abc import Callable

_IMPORT = re.compile(r"^from ([\w.]+) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
_NAME = re.compile(r"(\w+) as \w+")


def attach(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Args:
        package: Its ``__name__``.
        file: Its ``__file__``; beside it stands the ``__init__.pyi`` with a line
            ``from .file import Name as Name`` for each name, and
            ``from . import file as file`` for each file that is used as a whole.
    """
    listed = homes(file)
    names = sorted(listed, key=lambda name: (not name.isupper(), name))

    def load(name: str) -> object:
        home = listed.get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if home == ".":
            return import_module(f".{name}", package)
        return getattr(import_module(home, package), name)

    return load, lambda: names, names


def load_without(part: str, library: str) -> None:
    """Load a library without a part that it takes only where it is installed.

    For a part that takes long to load and gives nothing that is used there: not by
    pbonet, and not by modules and programs if they run in the same process. What
    imports the part later gets it. Nothing is done if there are several threads, of
    which another one may import the part meanwhile.

    Args:
        part: The module that is not to be loaded.
        library: The library, which is loaded now if it is not yet.
    """
    threads = sys._current_frames()  # noqa: SLF001 # pyright: ignore[reportPrivateUsage]
    if part in sys.modules or len(threads) > 1:
        return
    sys.modules[part] = None  # type: ignore[assignment]  # none to import
    try:
        import_module(library)
    finally:
        del sys.modules[part]


def homes(file: str) -> dict[str, str]:
    """Return where each name of a package that calls `attach` comes from.

    Args:
        file: The package's ``__file__``.
    """
    listed = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    return {
        name: home
        for home, several, one in _IMPORT.findall(listed)
        for name in _NAME.findall(several or one)
    }


def logger(name: str) -> logging.Logger:
    """Return a logger; `logging` is loaded only where something is logged."""
    import logging

    return logging.getLogger(name)
