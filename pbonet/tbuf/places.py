"""The files of links: making and finding them, and the roles of their users.

A link has one writer and one reader on a machine, and at most one agent that supervises
it; each holds a lock on one byte of the file, which the kernel releases when the
process ends for any reason. Every user also holds a shared lock on the whole file, as
for all express mail, so unused files are recognized.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbonet import shm
from pbonet.errors import (
    XmError,
    XmExistsError,
    XmMissingError,
    XmNameError,
    XmTakenError,
)
from pbonet.xm.ipc import FILES, folder_watch, names, shm_object_files

from . import _tbuf, layout
from ._tbuf import CARER, READER, WRITER, Buffer

if TYPE_CHECKING:
    import numpy as np

    from pbonet.xm.ipc import Name

KIND = "tbuf"
PATIENCE = 1.0
"""Seconds to wait for an ending process, or an agent that releases the role."""
_LOOK = 0.01
_FLOCK = struct.Struct("hhqqi4x")
_ROLES = {WRITER: "writer", READER: "reader", CARER: "agent"}


def name_to_read(text: str) -> Name:
    """Return the name of a link to read; by default of the own subsystem.

    Raises:
        XmNameError: The name is malformed.
    """
    home = names.home()
    return names.parse_at(text, home.subsystem or home.rtpu)


def name_to_write(text: str) -> Name:
    """Return the name of a link to write, which belongs to this process.

    Raises:
        XmNameError: The name is malformed, or belongs to another subsystem or RTPU.
    """
    name, home = name_to_read(text), names.home()
    if name.rtpu in {home.subsystem, home.rtpu}:
        return name
    owners = " or ".join(filter(None, (home.subsystem, home.rtpu)))
    raise XmNameError(
        "a link is named after its writer",
        where=str(name),
        expected=f"{owners}:{name.resource}",
        got=str(name),
        remedy=f"name it {name.resource}, or let {name.rtpu} write it",
    )


def attach(
    name: Name, dtype: np.dtype[Any] | None, role: int, end: Buffer
) -> np.dtype[Any]:
    """Map a link's buffer, made if there is none, and take a role in it.

    Args:
        name: The link.
        dtype: Required type of a record; None accepts the existing one.
        role: `WRITER`, `READER` or `CARER`.
        end: The buffer object to be mapped.

    Returns:
        The type of a record in the buffer.

    Raises:
        XmMissingError: There is no such link, and no `dtype` was given.
        XmLayoutError: The link has other records.
        XmTakenError: Another process has that role.
        XmError: The file cannot be used.
    """
    found = _open(name, dtype, end)
    try:
        _take(name, end, role)
    except BaseException:
        end.unmap()
        raise
    home = names.home()
    end.enter(role, f"process {os.getpid()} of {home.subsystem or home.rtpu}")
    return found


def _open(name: Name, dtype: np.dtype[Any] | None, end: Buffer) -> np.dtype[Any]:
    path = name.path(KIND)
    while True:
        try:
            fd, size = shm_object_files.open_file(name, KIND)
        except XmMissingError:
            if dtype is None:
                raise
            with contextlib.suppress(XmExistsError):
                return _make(path, dtype, end)
            continue
        try:
            end.map(fd, size, str(path))
            end.verify()
            found = layout.parse(end.text)
        except BaseException:
            end.unmap()
            raise
        if dtype is None or layout.same_values(dtype, found):
            return found
        end.unmap()
        if not FILES.remove_unused(path):
            raise layout.refuse(str(name), dtype, found)


def _make(path: Path, dtype: np.dtype[Any], end: Buffer) -> np.dtype[Any]:
    text = layout.describe(dtype)
    size = _tbuf.size_for(dtype.itemsize)
    fd, fresh = FILES.make(path, size)
    try:
        end.map(fd, size, str(path))
        end.make(dtype.itemsize, int.from_bytes(os.urandom(8)) >> 1, text)
        FILES.publish(fresh, path)
    except BaseException:
        end.unmap()
        fresh.unlink(missing_ok=True)
        raise
    return dtype


def _take(name: Name, end: Buffer, role: int) -> None:
    deadline = time.monotonic() + (0.0 if role == CARER else PATIENCE)
    while not try_take(end.fileno, role):
        if time.monotonic() >= deadline:
            what = _ROLES[role]
            raise XmTakenError(
                f"the link already has a {what}",
                where=str(name),
                got=end.who(role),
                remedy=f"end that one first, or give this {what} a link of its own",
            )
        time.sleep(_LOOK)


def try_take(fd: int, role: int) -> bool:
    """Take a role if it is free; return whether it was."""
    try:
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, _byte(fcntl.F_WRLCK, role))
    except (BlockingIOError, PermissionError):
        return False
    return True


def has(fd: int, role: int) -> bool:
    """Return whether another descriptor has the role."""
    answer = fcntl.fcntl(fd, fcntl.F_OFD_GETLK, _byte(fcntl.F_WRLCK, role))
    return int(_FLOCK.unpack(answer)[0]) != fcntl.F_UNLCK


def _byte(kind: int, role: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, role, 1, 0)


def leave(end: Buffer) -> None:
    """Detach; the last user removes the file."""
    if end.fileno >= 0:
        end.unmap()
        with contextlib.suppress(XmError):
            FILES.remove_unused(Path(end.path))


def standing(domain: str) -> list[str]:
    """Return the names of the links of a domain that exist on this machine."""
    return names.standing(KIND, domain)


class StandingLinks:
    """The links of a domain on this machine, for repeated listing.

    Args:
        domain: The domain.
    """

    def __init__(self, domain: str) -> None:
        self.domain = domain
        self._changes = folder_watch.Changes(str(shm.folder()))
        self._found: list[str] = []

    def names(self) -> list[str]:
        """Return their names; the folder is read only when it has changed."""
        if self._changes.changed():
            self._found = standing(self.domain)
        return self._found


def waiting() -> folder_watch.Waiting:
    """Return what waits until a link is made or removed on this machine."""
    return folder_watch.Waiting(str(shm.folder()))


def sweep(domain: str) -> list[str]:
    """Remove the unused links of a domain; return their names."""
    swept: list[str] = []
    for text in standing(domain):
        place, _, resource = text.partition(":")
        path = names.Name(domain, place, resource).path(KIND)
        with contextlib.suppress(XmError):
            if FILES.remove_unused(path):
                swept.append(text)
    return swept
