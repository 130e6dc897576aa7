"""The files behind tables: where they stand, who may open them, who still uses one.

Everybody who is attached holds a shared lock on the file, which the kernel drops when
the process ends. So a file that can be locked alone is one that a crash left behind.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import stat
from pathlib import Path

from pbonet.errors import (
    SvarAccessError,
    SvarDamagedError,
    SvarError,
    SvarExistsError,
    SvarFullError,
    SvarLayoutError,
    SvarMissingError,
)

from .native import VERSION, Arena
from .result_codes import Verdict

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,99}")


def machine() -> bytes:
    """Return the name of this machine, as causes of the flag carry it."""
    return os.uname().nodename.encode()


def map_whole(path: Path, fd: int, size: int) -> Arena:
    """Map a file whole; the descriptor is the arena's then, or closed.

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
            remedy="look at `ulimit -v` and `ulimit -l`",
        ) from None
    except BaseException:
        os.close(fd)
        raise


def folder() -> Path:
    """Return where shared memory files stand: ``PBONET_SHM_DIR``, or ``/dev/shm``."""
    return Path(os.environ.get("PBONET_SHM_DIR") or "/dev/shm")  # noqa: S108 - its place


def path_of(name: str) -> Path:
    """Return the file of the table `name` of this user.

    Raises:
        SvarError: The name cannot be part of a file's name.
    """
    if not _NAME.fullmatch(name):
        raise SvarError(
            f"{name!r} cannot be the name of a table",
            expected="letters, digits, and _ . + - behind the first, at most 100",
            remedy="rename the subsystem",
        )
    return folder() / f"pbonet.{os.geteuid()}.{name}.svar"


def make(path: Path, size: int, mode: int) -> tuple[int, Path]:
    """Make a file of zeros under a name of its own; return its descriptor and name.

    Its pages are allocated at once: a full /dev/shm is an error now, not a bus error in
    a control loop.

    Raises:
        SvarFullError: There is no room for it.
        SvarAccessError: The folder cannot be written to.
    """
    fresh = path.with_name(f"{path.name}.{os.getpid()}.new")
    fresh.unlink(missing_ok=True)
    try:
        fd = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    except OSError as error:
        raise _no_file(path, error) from None
    try:
        os.fchmod(fd, mode)
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        os.close(fd)
        fresh.unlink(missing_ok=True)
        raise _no_room(path, size, error) from None
    fcntl.flock(fd, fcntl.LOCK_SH)
    return fd, fresh


def publish(fresh: Path, path: Path) -> None:
    """Give a filled file its name; a file that a crash left there is replaced.

    Raises:
        SvarExistsError: A table of that name is in use.
        SvarAccessError: The folder takes no hard links.
    """
    try:
        for _ in range(16):
            try:
                path.hardlink_to(fresh)
            except FileExistsError:
                pass
            except OSError as error:
                raise _no_file(path, error) from None
            else:
                return
            if not _remove_leftover(path):
                break
    finally:
        fresh.unlink(missing_ok=True)
    raise SvarExistsError(
        "a table of this name stands already and is in use",
        where=str(path),
        remedy="attach to it, stop the subsystem that uses it, or choose another name",
    )


def remove(path: Path, fd: int) -> None:
    """Remove a table's file, if it still is the one behind the descriptor."""
    with contextlib.suppress(FileNotFoundError):
        if path.stat().st_ino == os.fstat(fd).st_ino:
            path.unlink()


def open_file(path: Path, least: int) -> tuple[int, int]:
    """Open a table's file of `least` bytes; return its descriptor and size.

    Raises:
        SvarMissingError: There is none.
        SvarAccessError: It is not this user's own, or open to others.
        SvarDamagedError: It is too short for a table.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        raise _missing(path) from None
    except OSError as error:
        raise _no_file(path, error) from None
    try:
        size = _judge_open(path, fd, least)
    except BaseException:
        os.close(fd)
        raise
    return fd, size


def _judge_open(path: Path, fd: int, least: int) -> int:
    _check_owner(path, os.fstat(fd))
    fcntl.flock(fd, fcntl.LOCK_SH)  # a leftover's judge holds it for an instant
    status = os.fstat(fd)
    if not status.st_nlink:
        raise _missing(path)
    if status.st_size < least:
        raise damaged(path, Verdict.NO_TABLE, status.st_size)
    return status.st_size


def check_mode(path: Path, fd: int, mode: int) -> None:
    """Refuse a file whose permissions were changed since the table was made.

    Raises:
        SvarAccessError: They were.
    """
    got = stat.S_IMODE(os.fstat(fd).st_mode)
    if got != mode:
        raise SvarAccessError(
            "the table's permissions are not those it was made with",
            where=str(path),
            expected=f"{mode:04o}",
            got=f"{got:04o}",
            remedy=f"chmod {mode:04o} {path}, if you trust who changed them",
        )


def must_be_whole(path: Path, fd: int, size: int) -> None:
    """Refuse a file that somebody has cut short since it was mapped.

    Raises:
        SvarDamagedError: Bytes that are mapped are not there any more.
    """
    left = os.fstat(fd).st_size
    if left < size:
        raise SvarDamagedError(
            "the table's file was truncated while it was in use",
            where=str(path),
            expected=f"{size} bytes",
            got=f"{left} bytes",
            remedy="its tasks die of it: stop the subsystem, which removes the file, "
            "and start it again; find out who writes to shared memory files",
        )


def _check_owner(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise SvarAccessError(
            "this is not a table's file",
            where=str(path),
            expected="a regular file",
            got=stat.filemode(status.st_mode),
            remedy="remove it; the subsystem makes its own",
        )
    if status.st_uid != os.geteuid():
        raise SvarAccessError(
            "the table belongs to somebody else",
            where=str(path),
            expected=f"user {os.geteuid()}",
            got=f"user {status.st_uid}",
            remedy="shared memory is each user's own; remove a stranger's file",
        )


def _remove_leftover(path: Path) -> bool:
    """Remove a file that nobody is attached to; False when somebody is."""
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return True
    except OSError as error:
        raise _no_file(path, error) from None
    try:
        _check_owner(path, os.fstat(fd))
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        remove(path, fd)
        return True
    finally:
        os.close(fd)


def _missing(path: Path) -> SvarMissingError:
    return SvarMissingError(
        "there is no such table",
        where=str(path),
        remedy="start the subsystem that makes it; `pbonet run` does so",
    )


def _no_file(path: Path, error: OSError) -> SvarError:
    if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE}:
        return _no_room(path, 0, error)
    reason = (
        "a symbolic link"
        if error.errno == errno.ELOOP
        else os.strerror(error.errno or 0)
    )
    return SvarAccessError(
        "the table's file cannot be opened",
        where=str(path),
        expected="a regular file of this user, readable and writable",
        got=reason,
        remedy="look at the permissions of the file and its folder",
    )


def _no_room(path: Path, size: int, error: OSError) -> SvarFullError:
    return SvarFullError(
        "there is no room for the table in shared memory",
        where=str(path),
        expected=f"{size} free bytes" if size else "",
        got=os.strerror(error.errno or 0),
        remedy=f"look at `df {path.parent}` and remove what crashes left there",
    )


def other_layout(where: str, wanted: str, got: str) -> SvarLayoutError:
    """Return the error for a table that does not mean what was asked for."""
    return SvarLayoutError(
        "a table of this name stands with another layout",
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


def closed(name: str) -> SvarError:
    """Return the error for a table that was let go."""
    return SvarError(
        "the table was closed", where=name, remedy="open it again with Table.attach"
    )


def stuck(where: str) -> SvarError:
    """Return the error for a lock that somebody holds without running."""
    return SvarError(
        "the lock between claimers was not free for 2 s",
        where=where,
        remedy="look for a stopped process (state T) that was changing ownership",
    )


def verify(path: Path, arena: Arena, size: int) -> None:
    """Refuse what is no sound table of this version.

    Raises:
        SvarLayoutError: It is of another version.
        SvarDamagedError: It is no table, cut short, or was overwritten.
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
    """Return the error for a file that is no sound table."""
    what = {
        Verdict.NO_TABLE: "the file is not a state variable table",
        Verdict.CUT_SHORT: "the table's file is cut short",
        Verdict.MOVING_PART: "the table's directory was overwritten",
    }.get(verdict, "the table's file was overwritten, its checksum is wrong")
    return SvarDamagedError(
        what,
        where=str(path),
        got=f"{size} bytes" if size else "",
        remedy="stop the subsystem, remove the file and start again",
    )
