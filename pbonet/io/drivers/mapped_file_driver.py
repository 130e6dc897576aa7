"""Memory that is mapped: class MEM, driver ``file``.

The address is a file, a device of UIO, or a name in shared memory. What is read by
`read` is recorded; what is read by `mmap` is in no log.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import stat
from typing import ClassVar

from pbonet.errors import DeviceError

from .device import Settings
from .device_classes import MemoryDevice
from .modes import Mode


class FileSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of mapped memory."""

    offset: int = 0
    """Where the device begins in the file, a multiple of the page size."""
    length: int = 0
    """Bytes; 0: to the end of the file."""


class FileDevice(MemoryDevice):
    """A file that is mapped into the task's memory."""

    settings_type: ClassVar[type[Settings]] = FileSettings
    can_trunc_lsb = False

    def connect(self) -> None:
        """Open the memory; see `Device.connect`."""
        k, write = self.settings, Mode.WRITE in self.opening.mode
        try:
            self._fd = os.open(
                self.entry.address, (os.O_RDWR if write else os.O_RDONLY) | os.O_CLOEXEC
            )
        except OSError as error:
            raise self._unusable(error) from None
        try:
            length = k.length or os.fstat(self._fd).st_size - k.offset
            self._map = mmap.mmap(
                self._fd,
                length,
                prot=mmap.PROT_READ | (mmap.PROT_WRITE if write else 0),
                offset=k.offset,
            )
        except (OSError, ValueError) as error:
            os.close(self._fd)
            raise self._unusable(error) from None
        self._ends_at = k.offset + length

    def disconnect(self) -> None:
        """Close the memory."""
        os.close(self._fd)
        with contextlib.suppress(BufferError):  # the module still holds a view
            self._map.close()

    def read(self, count: int, at: int = 0) -> bytes:
        """Return bytes of the memory; see `MemoryDevice.read`."""
        self.require(Mode.READ)
        data: bytes = self.ask(self._read, count, at, default=None)
        return data

    def _read(self, count: int, at: int) -> bytes:
        self._check(count, at)
        return self._map[at : at + count]

    def write(self, data: bytes, at: int = 0) -> int:
        """Write bytes into the memory; see `MemoryDevice.write`."""
        self.require(Mode.WRITE)
        self.ask(self._write, data, at, default=None)
        return len(data)

    def _write(self, data: bytes, at: int) -> None:
        self._check(len(data), at)
        self._map[at : at + len(data)] = data

    def mmap(self) -> memoryview:
        """Return the memory itself; see `MemoryDevice.mmap`."""
        if self.outside.plays:
            raise DeviceError(
                "memory that is mapped is in no log",
                where=self.name,
                remedy="take it with read() where a run must replay",
            )
        return memoryview(self._map)

    def _check(self, count: int, at: int) -> None:
        """Return if the memory has these bytes; a file may have become shorter.

        Raises:
            DeviceError: It has not, by what was asked for.
            OSError: The file is shorter than when it was opened.
        """
        if not 0 <= at <= at + count <= len(self._map):
            raise DeviceError(
                "the memory of the device has no such bytes",
                where=f"{self.name} ({self.entry.address})",
                expected=f"0 to {len(self._map) - 1}",
                got=f"{at} to {at + count - 1}",
                remedy="see length and offset in agent.toml",
            )
        if _size(self._fd) < self._ends_at:
            raise OSError("the file has become shorter")

    def check_safe(self) -> None:
        """Refuse safe values beyond the memory."""
        for at, data in self.safe.items():
            self._check(len(data), at)

    def _unusable(self, error: Exception) -> DeviceError:
        return DeviceError(
            "the memory of the device cannot be mapped",
            where=f"{self.name} ({self.entry.address})",
            got=str(error),
            remedy="check the path, its rights, offset and length",
        )


def _size(fd: int) -> int:
    """Return the size of a file; devices have none, and do not shrink."""
    found = os.fstat(fd)
    return found.st_size if stat.S_ISREG(found.st_mode) else 1 << 62
