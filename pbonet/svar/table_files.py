"""The files of tables: names, opening, and their errors."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING

from pbonet import shm
from pbonet.errors import (
    SvarAccessError,
    SvarDamagedError,
    SvarError,
    SvarExistsError,
    SvarFullError,
    SvarLayoutError,
    SvarMissingError,
)

from ._svar import STATIC_BYTES, VERSION, Arena
from .result_codes import GONE, Verdict

if TYPE_CHECKING:
    from pathlib import Path

OVERWRITTEN = "the table was overwritten in shared memory"
RESTART = (
    "stop the subsystem, which removes the file, and start it again; find the module "
    "or program that wrote there: an index out of bounds in native code, or a file "
    "opened by mistake"
)

FILES = shm.Files("table", SvarExistsError, SvarAccessError, SvarFullError)
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,99}")


def machine() -> bytes:
    """Return the name of this machine, as used in causes of the flag."""
    return os.uname().nodename.encode()


def map_whole(path: Path, fd: int, size: int) -> Arena:
    """Map a file whole; the arena then owns the descriptor, on an error it is closed.

    Raises:
        SvarFullError: It cannot be mapped.
    """
    try:
        return Arena(fd, size, machine())
    except MemoryError:
        os.close(fd)
        raise SvarFullError(
            "the table's file cannot be mapped into memory",
            where=str(path),
            expected=f"{size} bytes of address space that may be locked",
            remedy="check `ulimit -v` and `ulimit -l`",
        ) from None
    except BaseException:
        os.close(fd)
        raise


def path_of(name: str) -> Path:
    """Return this user's file of the table `name`.

    Raises:
        SvarError: The name is not valid in a file name.
    """
    if not _NAME.fullmatch(name):
        raise SvarError(
            f"{name!r} cannot be the name of a table",
            expected="letters, digits, and _ . + - after the first, at most 100",
            remedy="rename the subsystem",
        )
    return shm.path_of(f"{name}.svar")


def open_file(path: Path) -> tuple[int, int]:
    """Open a table's file; return its descriptor and size.

    Raises:
        SvarMissingError: There is no such file.
        SvarAccessError: It belongs to another user, or others may access it.
        SvarDamagedError: It is too short for a table.
    """
    try:
        fd, size = FILES.open(path)
    except FileNotFoundError:
        raise _missing(path) from None
    if size < STATIC_BYTES:
        os.close(fd)
        raise damaged(path, Verdict.NO_TABLE, size)
    return fd, size


def must_be_whole(path: Path, arena: Arena) -> None:
    """Refuse a file that was truncated or overwritten after it was mapped.

    Raises:
        SvarDamagedError: Mapped bytes are missing, or the directory is not valid.
    """
    size, left = arena.size, os.fstat(arena.fileno).st_size
    if left < size:
        raise SvarDamagedError(
            "the table's file was truncated while it was in use",
            where=str(path),
            expected=f"{size} bytes",
            got=f"{left} bytes",
            remedy="its tasks will die: stop the subsystem, which removes the file, "
            "and start it again; find out who writes to shared memory files",
        )
    if not arena.sound():
        raise overwritten(str(path))


def _missing(path: Path) -> SvarMissingError:
    return SvarMissingError(
        "there is no such table",
        where=str(path),
        remedy="start the subsystem that makes it, for example with `pbonet run`",
    )


def other_layout(where: str, wanted: str, got: str) -> SvarLayoutError:
    """Return the error for a table that has another layout."""
    return SvarLayoutError(
        "a table of this name exists with another layout",
        where=where,
        expected=f"layout {wanted}",
        got=f"layout {got}",
        remedy="stop the subsystem that uses it, or give this one another name",
    )


def no_lock(path: Path, error: int) -> SvarError:
    """Return the error for a machine whose C library has no lock for tables."""
    return SvarError(
        "the lock of the table cannot be made",
        where=str(path),
        got=os.strerror(error),
        remedy="a C library with robust mutexes between processes is needed",
    )


def overwritten(where: str = "") -> SvarDamagedError:
    """Return the error for a table whose mutable part was overwritten."""
    return SvarDamagedError(
        OVERWRITTEN, where=where, expected="what its tasks committed", remedy=RESTART
    )


def closed(name: str) -> SvarError:
    """Return the error for a closed table."""
    return SvarError(
        "the table was closed", where=name, remedy="open it again with Table.attach"
    )


def locked_out(where: str, code: int) -> SvarError:
    """Return the error for a lock that could not be taken.

    Args:
        where: The table.
        code: STUCK when its holder does not run, GONE when the table was overwritten.
    """
    if code == GONE:
        return overwritten(where)
    return SvarError(
        "the lock between claimers was not free for 2 s",
        where=where,
        remedy="check for a stopped process (state T) that was changing ownership",
    )


def verify(path: Path, arena: Arena, size: int) -> None:
    """Refuse a file that is not a sound table of this version.

    Raises:
        SvarLayoutError: It is of another version.
        SvarDamagedError: It is not a table, truncated, or was overwritten.
    """
    verdict = Verdict(arena.verify())
    if verdict is Verdict.OTHER_VERSION:
        raise SvarLayoutError(
            "the table was made by another version of pbonet",
            where=str(path),
            expected=f"table version {VERSION} and this machine's C library",
            got=f"table version {arena.version}",
            remedy="run the same version in every process of the subsystem",
        )
    if verdict is not Verdict.SOUND:
        raise damaged(path, verdict, size)


def damaged(path: Path, verdict: Verdict, size: int = 0) -> SvarDamagedError:
    """Return the error for a file that is not a sound table."""
    what = {
        Verdict.NO_TABLE: "the file is not a state variable table",
        Verdict.CUT_SHORT: "the table's file is truncated",
    }.get(verdict, "the table's file was overwritten, its checksum is wrong")
    return SvarDamagedError(
        what,
        where=str(path),
        got=f"{size} bytes" if size else "",
        remedy="stop the subsystem, remove the file and start again",
    )
