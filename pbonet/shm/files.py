"""Files in shared memory: make, publish, open, and remove unused ones.

Every attached process holds a shared lock on the file, which the kernel releases when
the process ends. So a file that can be locked exclusively has no users.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

    from pbonet.errors import PbonetError

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE}
_MODE = 0o600


class Files(NamedTuple):
    """The files of one kind of resource, and the errors that they raise.

    Args:
        what: The kind's name in messages.
        exists: Raised if a file of that name is in use.
        access: Raised for a file that this user cannot use, or that others can.
        full: Raised if there is no room.
    """

    what: str
    exists: type[PbonetError]
    access: type[PbonetError]
    full: type[PbonetError]

    def make(self, path: Path, size: int) -> tuple[int, Path]:
        """Make a file of zeros under another name; return its descriptor and path.

        Its pages are allocated at once: a full shared memory is an error now and not a
        bus error in a cycle.
        """
        fresh = path.with_name(f"{path.name}.{os.urandom(6).hex()}.new")
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        try:
            fd = os.open(fresh, flags, _MODE)
        except OSError as error:
            raise self._refused(path, error) from None
        try:
            os.fchmod(fd, _MODE)  # whatever the umask is
            fcntl.flock(fd, fcntl.LOCK_SH)
            os.posix_fallocate(fd, 0, size)
        except OSError as error:
            os.close(fd)
            fresh.unlink(missing_ok=True)
            raise self._refused(path, error, size) from None
        return fd, fresh

    def publish(self, fresh: Path, path: Path) -> None:
        """Give a filled file its name; an existing file without users is replaced."""
        try:
            for _ in range(16):
                if self._link(fresh, path):
                    return
                if not self.remove_unused(path):
                    break
        finally:
            fresh.unlink(missing_ok=True)
        raise self.exists(
            f"a {self.what} of this name already exists and is in use",
            where=str(path),
            remedy="attach to it, end what uses it, or choose another name",
        )

    def open(self, path: Path) -> tuple[int, int]:
        """Attach to a file; return its descriptor and size.

        Raises:
            FileNotFoundError: There is no such file.
        """
        fd = self._open(path)
        fcntl.flock(fd, fcntl.LOCK_SH)  # a remover holds it for an instant
        found = os.fstat(fd)
        if not found.st_nlink:
            os.close(fd)
            raise FileNotFoundError(errno.ENOENT, "removed meanwhile", str(path))
        return fd, found.st_size

    def remove_unused(self, path: Path) -> bool:
        """Remove a file without users; return False if it has any."""
        try:
            fd = self._open(path)
        except FileNotFoundError:
            return True
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            remove_same(path, fd)
        except BlockingIOError:
            return False
        finally:
            os.close(fd)
        return True

    def _link(self, fresh: Path, path: Path) -> bool:
        try:
            path.hardlink_to(fresh)
        except FileExistsError:
            return False
        except OSError as error:  # the folder does not support hard links
            raise self._refused(path, error) from None
        return True

    def _open(self, path: Path) -> int:
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise self._refused(path, error) from None
        found = os.fstat(fd)
        if found.st_uid == os.geteuid() and found.st_mode == stat.S_IFREG | _MODE:
            return fd
        os.close(fd)
        raise self.access(
            f"the {self.what}'s file is not this user's own",
            where=str(path),
            expected=f"a regular file of user {os.geteuid()} with mode {_MODE:04o}",
            got=f"{stat.filemode(found.st_mode)} of user {found.st_uid}",
            remedy="find out who made or changed it and remove it",
        )

    def _refused(self, path: Path, error: OSError, size: int = 0) -> PbonetError:
        got = os.strerror(error.errno or 0)
        if size or error.errno in _NO_ROOM:
            return self.full(
                f"there is no room for the {self.what} in shared memory",
                where=str(path),
                expected=f"{size} free bytes" if size else "",
                got=got,
                remedy=f"read `df {path.parent}` and remove what crashes left there",
            )
        return self.access(
            f"the {self.what}'s file cannot be opened",
            where=str(path),
            expected="a regular file of this user, readable and writable",
            got="a symbolic link" if error.errno == errno.ELOOP else got,
            remedy="check the permissions of the file and its folder",
        )


def remove_same(path: Path, fd: int) -> None:
    """Remove `path` if it is still the open file."""
    with contextlib.suppress(FileNotFoundError):
        if os.path.samestat(path.stat(), os.fstat(fd)):
            path.unlink()
