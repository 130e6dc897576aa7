"""The modules of this machine's library, as the command `module` shows them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.config import Library
from pbonet.errors import PbonetError, StateError

if TYPE_CHECKING:
    from collections.abc import Sequence

Data = dict[str, Any]


def is_subsystem(word: str | None) -> bool:
    """Return whether a word is the file of a subsystem, not a module."""
    return word is not None and Path(word).suffix in {".sbs", ".job"}


def describe(
    what: str | None, more: str | None, folders: Sequence[str]
) -> tuple[Data, list[str]]:
    """Return the descriptions of one module or of all, and warnings.

    Args:
        what: A module's name or an ``.rmod`` file; None for all modules.
        more: A further word, which only a subsystem's file takes.
        folders: Folders beside pbonet's own modules.

    Raises:
        StateError: There is a word too many.
        ConfigError: The ``.rmod`` file is wrong.
        ModuleLoadError: There is no such module, or it does not load.
    """
    if more is not None:
        raise StateError(
            f"{what} is no subsystem's file, so {more} is one word too many",
            expected="MODULE, FILE.rmod, or FILE.sbs MODULE",
            remedy="name the .sbs file of the subsystem first",
        )
    library = Library(folders)
    if what is None:
        return _all(library)
    if what.endswith(".rmod"):
        info = library.load_rmod(library.read_rmod(what)).info
    else:
        info = library.load(what).info
    return {"module": msgspec.to_builtins(info)}, []


def _all(library: Library) -> tuple[Data, list[str]]:
    found: list[Data] = []
    warnings: list[str] = []
    for name in library.modules():
        try:
            info = library.load(name).info
        except PbonetError as error:
            warnings.append(str(error))
            continue
        found.append({"name": name, "version": info.version, "doc": info.doc})
    return {"modules": found, "rmods": list(library.rmods())}, warnings
