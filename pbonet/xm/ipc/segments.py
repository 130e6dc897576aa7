"""Shared memory segments by name (Stewart 1994, section 5.4.1).

A segment is plain memory that processes of one machine share. They must agree on its
layout and on when each may write, if necessary with a semaphore. Attached processes are
counted by locks on the file, which the kernel releases when a process ends.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pbonet import shm
from pbonet.errors import (
    XmDamagedError,
    XmDestroyedError,
    XmError,
    XmFullError,
    XmLayoutError,
)
from pbonet.outside import refuse

from . import names, shm_object_files

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray

    from .names import Name

KIND = "shm"
MEMBERS = 128
"""Maximum number of processes attached at a time."""
VERSION = 1
_MAGIC = b"pbonetSM"
_HEAD = struct.Struct("8sIIQ")
_DESTROYED = 12  # offset of that word in the head
_START = 64  # offset of the user's bytes
_FLOCK = struct.Struct("hhqqi4x")
_ELSEWHERE = (
    "memory is shared within a machine only; to another one use a link (pbonet.tbuf), "
    "or a variable of the table"
)


class Segment(shm.Closeable):
    """An attached segment (``shmCreate``, ``shmAttach``).

    Attributes:
        name: ``RTPU:RESOURCE``.
        size: Size in bytes.
    """

    name: str
    size: int

    def __init__(self, name: Name, fd: int, size: int) -> None:
        self.name, self.size = str(name), size - _START
        self._path, self._fd = name.path(KIND), fd
        self._map: mmap.mmap | None = mmap.mmap(fd, size)

    @classmethod
    def create(cls, name: str | Name, size: int) -> Self:
        """Make a segment of zeros; an existing one without users is replaced.

        Args:
            name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
            size: Size in bytes.

        Raises:
            XmExistsError: A segment of that name is in use.
            XmFullError: Shared memory is full.
            UnreachableError: The RTPU is not on this machine.
            XmError: The file cannot be made.
            ValueError: `size` is not positive.
        """
        if size <= 0:
            raise ValueError(f"a segment has at least one byte, not {size}")
        refuse(f"the shared memory segment {name}")
        found = names.resolve(name, remedy=_ELSEWHERE)
        fd, fresh = shm_object_files.FILES.make(found.path(KIND), _START + size)
        self = cls(found, fd, _START + size)
        try:
            self._bytes()[: _HEAD.size] = _HEAD.pack(_MAGIC, VERSION, 0, size)
            self._enter()
            shm_object_files.FILES.publish(fresh, self._path)
        except BaseException:
            fresh.unlink(missing_ok=True)
            self._let_go()
            raise
        return self

    @classmethod
    def attach(cls, name: str | Name) -> Self:
        """Attach to an existing segment.

        Raises:
            XmMissingError: There is no segment of that name.
            UnreachableError: The RTPU is not on this machine.
            XmDamagedError: The file is not a segment.
            XmFullError: Too many processes are attached.
            XmError: Its file cannot be used.
        """
        refuse(f"the shared memory segment {name}")
        found = names.resolve(name, remedy=_ELSEWHERE)
        fd, size = shm_object_files.open_file(found, KIND)
        if size < _START:
            os.close(fd)
            raise _damaged(found.path(KIND), size)
        self = cls(found, fd, size)
        try:
            self._verify()
            self._enter()
        except BaseException:
            self._let_go()
            raise
        return self

    @property
    def attached(self) -> int:
        """Number of attached processes, including this one."""
        self._bytes()
        return 1 + sum(self._is_taken(member) for member in range(MEMBERS))

    @property
    def memory(self) -> memoryview:
        """The segment's bytes.

        Raises:
            XmDestroyedError: It was destroyed.
        """
        whole = self._bytes()
        if struct.unpack_from("I", whole, _DESTROYED)[0]:
            raise XmDestroyedError(
                "the segment was destroyed",
                where=self.name,
                remedy="create it again, or attach to the new one",
            )
        return whole[_START:]

    def array(
        self, dtype: DTypeLike, shape: int | tuple[int, ...] = (), offset: int = 0
    ) -> NDArray[Any]:
        """Return an array in the segment.

        Args:
            dtype: Type of its elements.
            shape: Its shape; () for one element.
            offset: Offset in bytes; 0 is aligned for every type.

        Raises:
            XmLayoutError: The array does not fit.
        """
        import numpy as np  # not in an agent, which only removes segments

        kind, count = np.dtype(dtype), int(np.prod(shape, dtype=np.int64))
        if offset < 0 or offset + kind.itemsize * count > self.size:
            raise XmLayoutError(
                "the array does not fit into the segment",
                where=self.name,
                expected=f"at most {self.size} bytes",
                got=f"{kind.itemsize * count} bytes from {offset} on",
                remedy="make the segment larger where it is created",
            )
        return np.ndarray(shape, kind, self.memory, offset)

    def close(self) -> None:
        """Detach (``shmDetach``); arrays obtained from it remain valid."""
        self._let_go()

    def destroy(self) -> None:
        """Remove it (``shmDestroy``); other users keep their arrays and get errors."""
        if self._map is not None:
            shm.remove_same(self._path, self._fd)
            struct.pack_into("I", self._bytes(), _DESTROYED, 1)
            self._let_go()

    def __repr__(self) -> str:
        return f"<Segment {self.name}, {self.size} bytes>"

    def _bytes(self) -> memoryview:
        if self._map is None:
            raise XmError(
                "the segment is closed", where=self.name, remedy="attach to it again"
            )
        return memoryview(self._map)

    def _verify(self) -> None:
        magic, version, _, size = _HEAD.unpack_from(self._bytes())
        if magic != _MAGIC or size != self.size:
            raise _damaged(self._path, self.size + _START)
        if version != VERSION:
            raise XmLayoutError(
                "the segment was made by another version of pbonet",
                where=str(self._path),
                expected=f"version {VERSION}",
                got=f"version {version}",
                remedy="run the same version in every process",
            )

    def _enter(self) -> None:
        """Take a place among the attached processes: a lock on one byte."""
        for member in range(MEMBERS):
            try:
                fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _lock(fcntl.F_WRLCK, member))
            except (BlockingIOError, PermissionError):
                continue
            return
        raise XmFullError(
            "too many processes are attached",
            where=self.name,
            expected=f"at most {MEMBERS}",
            remedy="close it in processes that no longer need it",
        )

    def _is_taken(self, member: int) -> bool:
        """Return whether another process holds that place."""
        answer = fcntl.fcntl(self._fd, fcntl.F_OFD_GETLK, _lock(fcntl.F_WRLCK, member))
        return int(_FLOCK.unpack(answer)[0]) != fcntl.F_UNLCK

    def _let_go(self) -> None:
        """Release locks and map; the memory remains as long as an array needs it."""
        if self._map is not None:  # the map keeps the file open, so unlock explicitly
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _lock(fcntl.F_UNLCK, 0, MEMBERS))
            fcntl.flock(self._fd, fcntl.LOCK_UN)
            os.close(self._fd)
            self._map = None

    def __del__(self) -> None:
        if getattr(self, "_map", None) is not None:
            self._let_go()


def _lock(kind: int, member: int, count: int = 1) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, member, count, 0)


def _damaged(path: Path, size: int) -> XmDamagedError:
    return XmDamagedError(
        "the file is damaged, or is not a segment",
        where=str(path),
        got=f"{size} bytes",
        remedy="stop the processes that use it, and remove it",
    )
