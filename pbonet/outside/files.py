"""Files that a module reads: the log has their hashes, and a replay compares them."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Final, NamedTuple

from ._tape import Outside, active

if TYPE_CHECKING:
    from pathlib import Path

    from .playing import Player

_SOURCE: Final = "file"


class ReadFile(NamedTuple):
    """A file as a module read it."""

    name: str
    """As its parameter names it."""
    path: str
    """Where it was found."""
    sha256: str


def note_file(name: str, path: Path) -> None:
    """Note in the log which file a module reads.

    Args:
        name: As a parameter names it.
        path: Where it was found.
    """
    if active():
        Outside(_SOURCE).ask(lambda: (name, str(path.absolute()), sha256_of(path)))


def files_read(player: Player) -> list[ReadFile]:
    """Return the files that are noted among recorded answers, in their order."""
    return [ReadFile(*one) for one in player.answers_of(_SOURCE)]


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content; nothing if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
