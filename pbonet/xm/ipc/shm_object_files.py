"""The files behind semaphores and queues: made, found, judged, swept.

Everybody who is attached holds a shared lock on the file, which the kernel drops when
the process ends. So a file that can be locked alone is one that nobody uses.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from typing import TYPE_CHECKING

from pbonet.errors import XmAccessError, XmError, XmExistsError, XmFullError

from . import names

if TYPE_CHECKING:
    from pathlib import Path

    from .names import Name


def make(path: Path, size: int) -> tuple[int, Path]:
    """Make a file of zeros under a name of its own; return its descriptor and path.

    Its pages are allocated at once: a full shared memory is an error now, not a bus
    error in a cycle.

    Raises:
        XmFullError: There is no room.
        XmAccessError: The folder cannot be written to.
    """
    fresh = path.with_name(f"{path.name}.{os.urandom(6).hex()}.new")
    try:
        fd = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise _refused(path, error) from None
    try:
        fcntl.flock(fd, fcntl.LOCK_SH)
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        os.close(fd)
        fresh.unlink(missing_ok=True)
        raise _refused(path, error, size) from None
    return fd, fresh


def publish(fresh: Path, path: Path) -> None:
    """Give a filled file its name; a file that nobody uses is replaced.

    Raises:
        XmExistsError: One of that name is in use.
    """
    try:
        for _ in range(16):
            with contextlib.suppress(FileExistsError):
                path.hardlink_to(fresh)
                return
            if not remove_unused(path):
                break
    finally:
        fresh.unlink(missing_ok=True)
    raise XmExistsError(
        "one of this name stands already and is in use",
        where=str(path),
        remedy="attach to it, destroy it, or choose another name",
    )


def open_file(name: Name, kind: str) -> tuple[int, int]:
    """Open a resource's file; return its descriptor and size.

    Raises:
        XmMissingError: There is none.
        XmAccessError: It is not this user's own.
    """
    path = name.path(kind)
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        raise names.missing(name, kind) from None
    except OSError as error:
        raise _refused(path, error) from None
    try:
        _check_owner(path, os.fstat(fd))
        fcntl.flock(fd, fcntl.LOCK_SH)  # a remover holds it for an instant
    except BaseException:
        os.close(fd)
        raise
    found = os.fstat(fd)
    if not found.st_nlink:
        os.close(fd)
        raise names.missing(name, kind)
    return fd, found.st_size


def unlink_same(path: Path, fd: int) -> None:
    """Remove `path` if it still is the open file."""
    with contextlib.suppress(FileNotFoundError):
        if os.path.samestat(path.stat(), os.fstat(fd)):
            path.unlink()


def remove_unused(path: Path) -> bool:
    """Remove a file that nobody is attached to; False when somebody is."""
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return True
    except OSError as error:
        raise _refused(path, error) from None
    try:
        _check_owner(path, os.fstat(fd))
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        unlink_same(path, fd)
        return True
    finally:
        os.close(fd)


def sweep(rtpu: str, domain: str = "default") -> list[str]:
    """Remove what nobody uses any more of an RTPU; return the files' last parts.

    For when an RTPU ends, or begins where one was killed.
    """
    swept: list[str] = []
    prefix = f"pbonet.{os.geteuid()}.{domain}:{rtpu}:"
    for path in sorted(names.folder().glob(f"{prefix}*")):
        with contextlib.suppress(XmError):
            if remove_unused(path):
                swept.append(path.name.removeprefix(prefix))
    return swept


def _check_owner(path: Path, found: os.stat_result) -> None:
    if (
        not stat.S_ISREG(found.st_mode)
        or found.st_uid != os.geteuid()
        or found.st_mode & 0o077
    ):
        raise XmAccessError(
            "the file is not this user's own",
            where=str(path),
            expected=f"a regular file of user {os.geteuid()} with mode 0600",
            got=f"{stat.filemode(found.st_mode)} of user {found.st_uid}",
            remedy="find out who made it and remove it",
        )


def _refused(path: Path, error: OSError, size: int = 0) -> XmError:
    if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE}:
        return XmFullError(
            "there is no room for it in shared memory",
            where=str(path),
            expected=f"{size} free bytes" if size else "",
            got=os.strerror(error.errno),
            remedy=f"look at `df {path.parent}` and remove what crashes left there",
        )
    link = error.errno == errno.ELOOP
    return XmAccessError(
        "the file cannot be opened",
        where=str(path),
        expected="a regular file of this user, readable and writable",
        got="a symbolic link" if link else os.strerror(error.errno or 0),
        remedy="look at the permissions of the file and its folder",
    )
