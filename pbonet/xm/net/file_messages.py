"""Requests about the files of another machine (Stewart 1994, section 5.3.2).

Paths are relative to the folder that the agent declares (`files` of agent.toml). A file
is written under a temporary name beside its path, and moved there when it is complete.
"""

from __future__ import annotations

from msgspec import Struct

from .resource_messages import XmRequest

CHUNK = 512 * 1024
"""Bytes of a file per request."""
PAGE = 1000
"""Entries of a folder per request."""


class FileStat(XmRequest, tag="xm_stat"):
    """Ask for the entry at a path. Result: `FileSeen`."""

    path: str


class FileList(XmRequest, tag="xm_list"):
    """List a folder. Result: `Listing`."""

    path: str
    after: str = ""
    """The last name of the previous page."""


class FileRead(XmRequest, tag="xm_read"):
    """Read a part of a file. Result: bytes, empty after its end."""

    path: str
    offset: int
    size: int
    inode: int = 0
    """Of the file that was opened; another file is refused."""


class FileWrite(XmRequest, tag="xm_write"):
    """Write a part of a new file. Result: None."""

    path: str
    part: str
    """The client's name for it until it is complete."""
    offset: int
    data: bytes


class FileFinish(XmRequest, tag="xm_finish"):
    """Move a complete file to its path, or discard it. Result: None."""

    path: str
    part: str
    size: int
    keep: bool
    fresh: bool = False
    """Refuse if there is already a file."""


class FileChange(XmRequest, tag="xm_change"):
    """Make or remove a file or folder. Result: None."""

    path: str
    what: str
    """``mkdir``, ``rmdir``, ``remove``, or ``touch``: set its time to now."""


class FileMove(XmRequest, tag="xm_move"):
    """Move a file or folder within the agent's folder, atomically. Result: None."""

    path: str
    to: str
    """Its new path; an existing file is replaced."""


class FileSeen(Struct, kw_only=True):
    """The entry at a path."""

    name: str
    """The last part of the path."""
    type: str
    """``file``, ``directory`` or ``other``."""
    size: int = 0
    mtime: float = 0.0
    """Seconds since 1970 by its machine's clock, for display."""
    inode: int = 0
    link: bool = False
    """Whether the path is a symbolic link; the other fields describe its target."""


class Listing(Struct, kw_only=True):
    """A page of a folder's entries, sorted by name."""

    entries: list[FileSeen]
    more: bool
    last: str = ""
    """The last name of this page."""


LOOKING = FileStat | FileList | FileRead
AnyFileRequest = LOOKING | FileWrite | FileFinish | FileChange | FileMove
