"""The modules of this machine's library, as the command `library` shows them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbonet.config import Found, Library, Search, described, search

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Data = dict[str, Any]


def is_subsystem(word: str) -> bool:
    """Return whether a word is the file of a subsystem, not a module."""
    return Path(word).suffix in {".sbs", ".job"}


def find(
    text: Sequence[str], wanted: Mapping[str, str | None], folders: Sequence[str]
) -> tuple[Data, list[str]]:
    """Return the modules that are searched for as data, and warnings.

    Args:
        text: A module's name, an ``.rmod`` file, or its name in the library, or words.
        wanted: The other fields of `Search`.
        folders: Folders beside pbonet's own modules and the current folder.

    Raises:
        ConfigError: The ``.rmod`` file is wrong or missing, or there is no such class.
        ModuleLoadError: There is no such module, or it does not load.
    """
    library = Library([*folders, Path()])
    if len(text) == 1 and text[0].endswith(".rmod"):
        given = Path(text[0])
        path = given if given.is_file() else library.find_rmod(text[0])
        rmod = library.read_rmod(path)
        info = library.load_rmod(rmod).info
        return {"modules": [Found(info=info, rmods=(rmod.name,)).data]}, []
    asked = Search(
        text=tuple(text), **{name: word or "" for name, word in wanted.items()}
    )
    if len(text) == 1 and text[0] in library.files():
        infos, faults = [library.load(text[0]).info], list[str]()
    else:
        infos, faults = described(library)
    found = search(infos, library.records(), asked)
    return {"modules": [one.data for one in found]}, faults
