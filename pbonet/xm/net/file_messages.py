"""Requests about the files of another machine (Stewart 1994, section 5.3.2).

Paths are relative to the folder that the agent declares (`files` of agent.toml). A file
is written beside its place under a name of its own, and moved there when it is whole.
"""

from __future__ import annotations

from msgspec import Struct

from .resource_messages import XmRequest

CHUNK = 512 * 1024
"""Bytes of a file that travel at a time."""
PAGE = 1000
"""Entries of a folder that travel at a time."""


class FileStat(XmRequest, tag="xm_stat"):
    """Ask what stands at a path. Result: `FileSeen`."""

    path: str


class FileList(XmRequest, tag="xm_list"):
    """Ask what a folder holds. Result: `Listing`."""

    path: str
    after: str = ""
    """The last name of the page before."""


class FileRead(XmRequest, tag="xm_read"):
    """Read a part of a file. Result: bytes, none behind its end."""

    path: str
    offset: int
    size: int
    inode: int = 0
    """Of the file that was read before; another one is refused."""


class FileWrite(XmRequest, tag="xm_write"):
    """Write a part of a file that is not there yet. Result: None."""

    path: str
    part: str
    """The client's name for it until it is whole."""
    offset: int
    data: bytes


class FileFinish(XmRequest, tag="xm_finish"):
    """Move a whole file to its place, or drop it. Result: None."""

    path: str
    part: str
    size: int
    keep: bool
    fresh: bool = False
    """Refuse if there is a file already."""


class FileChange(XmRequest, tag="xm_change"):
    """Make or remove something. Result: None."""

    path: str
    what: str
    """``mkdir``, ``rmdir``, ``remove``, or ``touch``: set its time to now."""


class FileMove(XmRequest, tag="xm_move"):
    """Move a file or a folder within the agent's folder, at once. Result: None."""

    path: str
    to: str
    """Its new path; a file that stands there is replaced."""


class FileSeen(Struct, kw_only=True):
    """The entry at a path."""

    name: str
    """The last part of the path."""
    type: str
    """``file``, ``directory`` or ``other``."""
    size: int = 0
    mtime: float = 0.0
    """Seconds since 1970 as its machine counts them, for people."""
    inode: int = 0
    link: bool = False
    """Whether the path is a symbolic link; the rest is told of what it leads to."""


class Listing(Struct, kw_only=True):
    """A page of what a folder holds, sorted by name."""

    entries: list[FileSeen]
    more: bool
    last: str = ""
    """The last name that was looked at."""


LOOKING = FileStat | FileList | FileRead
AnyFileRequest = LOOKING | FileWrite | FileFinish | FileChange | FileMove
