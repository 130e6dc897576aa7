"""Checks the file of a shared object before it is loaded.

The loader of the system says of a file for another machine only that it cannot open it,
and a file that is cut short ends the process.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Final

from pbonet.errors import ModuleLoadError

_MACHINE: Final = slice(18, 20)
_WIDE = struct.calcsize("P") == 8  # noqa: PLR2004 - bytes of a pointer
_HEADER = struct.Struct("=24xQQQIHHH" if _WIDE else "=24xIIIIHHH")
"""Entry, place of the program headers, ...; their size and number come last."""
_SEGMENT = struct.Struct("=I4xQ16xQ" if _WIDE else "=II8xI")
"""Of a program header: type, place in the file, bytes in the file."""
_LOAD: Final = 1
_NAMES = {3: "x86", 40: "ARM", 62: "x86-64", 183: "AArch64", 243: "RISC-V"}


def check_file(path: Path, data: bytes) -> None:
    """Refuse a file that is no whole shared object of this machine.

    Args:
        path: The file.
        data: Its content.

    Raises:
        ModuleLoadError: It is another kind of file, or not all of it is there.
    """
    if data[:4] != b"\x7fELF" or len(data) < _HEADER.size:
        raise ModuleLoadError(
            "the file is no shared object",
            where=str(path),
            remedy="build it with `cc -shared -fPIC`",
        )
    with Path("/proc/self/exe").open("rb") as own:
        mine = own.read(_MACHINE.stop)
    if _identity(data) != _identity(mine):
        raise ModuleLoadError(
            "the shared object is for another machine",
            where=f"{path}: e_machine",
            expected=_machine(mine),
            got=_machine(data),
            remedy="build it on this machine, or for it",
        )
    if (whole := _size(data)) > len(data):
        raise ModuleLoadError(
            "the shared object is cut short",
            where=str(path),
            expected=f"at least {whole} bytes",
            got=f"{len(data)} bytes",
            remedy="build or copy it again",
        )


def _identity(data: bytes) -> tuple[bytes, bytes]:
    """Return class and byte order, and the machine."""
    return data[4:6], data[_MACHINE]


def _machine(data: bytes) -> str:
    """Return class, byte order and machine of a file in words."""
    number = int.from_bytes(data[_MACHINE], "big" if data[5] > 1 else "little")
    order = "big-endian" if data[5] > 1 else "little-endian"
    return f"{_NAMES.get(number, f'machine {number}')}, {32 * data[4]} bits, {order}"


def _size(data: bytes) -> int:
    """Return the bytes that the file must have: to the end of what is loaded."""
    at: int
    size: int
    count: int
    _, at, _, _, _, size, count = _HEADER.unpack_from(data)
    end = at + size * count
    if end > len(data) or size < _SEGMENT.size:
        return end
    for k in range(count):
        kind, place, more = _SEGMENT.unpack_from(data, at + k * size)
        if kind == _LOAD:
            end = max(end, int(place + more))
    return end
