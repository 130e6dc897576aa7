"""Files of this machine for other machines, confined to one folder (section 5.3.2).

A path is resolved to its real target, which must be within the folder. It is then
opened from the folder downwards without following links, so that a link created
meanwhile is refused, too.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import stat
import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.errors import (
    NodeError,
    PbonetError,
    XmAccessError,
    XmError,
    XmExistsError,
    XmFullError,
    XmLapsedError,
    XmMissingError,
    XmNameError,
)
from pbonet.xm.net import file_messages as f

if TYPE_CHECKING:
    from collections.abc import Callable, Generator
    from typing import Any

LONGEST = 1024
"""Maximum length of a path in bytes."""
DEEPEST = 64
"""Maximum number of folders in a path."""
PARTS = 64
"""Maximum number of files being written at a time."""
_PART = re.compile(r"[0-9a-f]{1,32}")
_ACCESS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ELOOP, errno.ENXIO}
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class FileServer:
    """Reads and writes files for clients on other machines.

    Args:
        root: The folder; None refuses all requests.
        rtpu: The RTPU's name.

    Raises:
        NodeError: The folder cannot be used.
    """

    def __init__(self, root: str | None, rtpu: str) -> None:
        self._rtpu = rtpu
        self._root: Path | None = None
        self._guard = threading.Lock()
        self._parts: dict[tuple[str, str], str] = {}
        """Paths of files being written, by client and part."""
        if root is not None:
            self._root = Path(root).resolve()
            if not self._root.is_dir():
                raise NodeError(
                    "the folder of files for other machines does not exist",
                    where=str(root),
                    remedy="make it, or name another one (files in agent.toml)",
                )

    @property
    def operations(self) -> dict[type, Callable[[Any], Any]]:
        """The handler of each request."""
        return {
            f.FileStat: self._stat,
            f.FileList: self._list,
            f.FileRead: self._read,
            f.FileWrite: self._write,
            f.FileFinish: self._finish,
            f.FileChange: self._change,
            f.FileMove: self._move,
        }

    def is_used(self) -> bool:
        """Return whether clients have unfinished files here."""
        with self._guard:
            return bool(self._parts)

    def lost(self, client: str) -> None:
        """Remove the unfinished files of a client that is gone."""
        with self._guard:
            theirs = [key for key in self._parts if key[0] == client]
        for key in theirs:
            self._drop(key)

    # -- resolving paths ---------------------------------------------------------------

    def _where(self, path: str) -> str:
        return f"{self._rtpu}:{path[:100]}"

    def _real(self, path: str, *, parent: bool = False) -> tuple[Path, list[str]]:
        """Return the root, and the parts of the real path below it.

        Args:
            path: The requested path.
            parent: Resolve only its folder: the last part may be new, or a link.
        """
        root = self._root
        if root is None:
            raise XmAccessError(
                "this agent declares no files",
                where=self._rtpu,
                expected="files = FOLDER in its agent.toml, or --files FOLDER",
                remedy="start it with one of these; every master can then write to it",
            )
        parts = [part for part in path.split("/") if part not in {"", "."}]
        if (
            "\0" in path
            or ".." in parts
            or len(parts) > DEEPEST
            or len(path.encode(errors="surrogatepass")) > LONGEST
        ):
            raise XmNameError(
                "this is not a valid path",
                where=self._where(path),
                expected=f"at most {DEEPEST} names without .., {LONGEST} bytes in all",
                got=repr(path[:100]),
                remedy="give the path relative to the agent's folder",
            )
        kept = parts[-1:] if parent else []
        real = Path(os.path.realpath(root.joinpath(*parts[: len(parts) - len(kept)])))
        if real != root and root not in real.parents:
            raise XmAccessError(
                "the path leads out of the agent's folder",
                where=self._where(path),
                remedy="copy the file into the folder",
            )
        return root, [*real.relative_to(root).parts, *kept]

    @contextlib.contextmanager
    def _folder(
        self, path: str, *, parent: bool = False
    ) -> Generator[tuple[int, str], None, None]:
        """Open the folder of a path's last part; yield it and that part."""
        root, parts = self._real(path, parent=parent)
        flags = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
        fd = os.open(root, flags)
        try:
            for part in parts[:-1]:
                deeper = os.open(part, flags, dir_fd=fd)
                os.close(fd)
                fd = deeper
            yield fd, parts[-1] if parts else "."
        except OSError as error:
            if isinstance(error, PbonetError):
                raise
            raise self._fault(path, error) from None
        finally:
            os.close(fd)

    def _fault(self, path: str, error: OSError) -> XmError:
        reason = os.strerror(error.errno or 0)
        if error.errno in {errno.ENOENT, errno.ENOTDIR}:
            return XmMissingError(
                "there is no such file",
                where=self._where(path),
                remedy="list its folder",
            )
        kind = XmError
        if error.errno in _ACCESS:
            kind = XmAccessError
        elif error.errno in _FULL:
            kind = XmFullError
        elif error.errno == errno.EEXIST:
            kind = XmExistsError
        return kind(
            "the file cannot be used",
            where=self._where(path),
            got=reason,
            remedy="check the file on its machine",
        )

    # -- reading -----------------------------------------------------------------------

    def _stat(self, request: f.FileStat) -> f.FileSeen:
        with self._folder(request.path) as (fd, name):
            found = os.stat(name, dir_fd=fd, follow_symlinks=False)
        seen = _seen(request.path.rstrip("/").rpartition("/")[2], found)
        seen.link = self._is_link(request.path)
        return seen

    def _is_link(self, path: str) -> bool:
        """Return whether a path is a symbolic link, whatever its target."""
        try:
            with self._folder(path, parent=True) as (fd, name):
                found = os.stat(name, dir_fd=fd, follow_symlinks=False)
        except XmMissingError:
            return False
        return stat.S_ISLNK(found.st_mode)

    def _list(self, request: f.FileList) -> f.Listing:
        with self._folder(request.path) as (fd, name):
            here = os.open(
                name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=fd
            )
            try:
                names = sorted(n for n in os.listdir(here) if n > request.after)  # noqa: PTH208 - of a descriptor
            finally:
                os.close(here)
        entries: list[f.FileSeen] = []
        for one in names[: f.PAGE]:
            try:
                one.encode()
                entries.append(self._stat(f.FileStat(path=f"{request.path}/{one}")))
            except UnicodeEncodeError:
                continue  # the name cannot be sent
            except XmError as error:
                link = self._is_link(f"{request.path}/{one}")
                if link or not isinstance(error, XmMissingError):  # else it has gone
                    entries.append(f.FileSeen(name=one, type="other", link=link))
        page = names[: f.PAGE]
        last = page[-1].encode(errors="replace").decode() if page else ""
        return f.Listing(entries=entries, more=len(names) > f.PAGE, last=last)

    def _read(self, request: f.FileRead) -> bytes:
        with self._folder(request.path) as (fd, name):
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            here = os.open(name, flags, dir_fd=fd)
            try:
                found = os.fstat(here)
                if not stat.S_ISREG(found.st_mode):
                    raise XmAccessError(
                        "this is not a regular file",
                        where=self._where(request.path),
                        got=stat.filemode(found.st_mode),
                        remedy="read files, list folders",
                    )
                if request.inode not in {0, found.st_ino}:
                    raise XmLapsedError(
                        "the file was replaced while it was read",
                        where=self._where(request.path),
                        remedy="open it again",
                    )
                size = max(0, min(request.size, f.CHUNK))
                return os.pread(here, size, max(0, request.offset))
            finally:
                os.close(here)

    # -- changing ----------------------------------------------------------------------

    def _beside(self, request: f.FileWrite | f.FileFinish) -> str:
        """Return the temporary path of a file being written."""
        if not self._real(request.path, parent=True)[1]:
            raise XmNameError(
                "the path names no file",
                where=self._where(request.path),
                remedy="name a file in the agent's folder",
            )
        if not _PART.fullmatch(request.part):
            raise XmNameError(
                "this is not a valid name of a part",
                where=self._where(request.path),
                expected="up to 32 hexadecimal digits",
                got=repr(request.part[:40]),
                remedy="run the same pbonet version on every machine",
            )
        folder, slash, name = request.path.rstrip("/").rpartition("/")
        begin = name.encode()[:200].decode(errors="ignore")  # names have 255 bytes
        return f"{folder}{slash}.{begin}.{request.part}.part"

    def _write(self, request: f.FileWrite) -> None:
        beside, key = self._beside(request), (request.client, request.part)
        with self._guard:
            known = self._parts.get(key) == beside
            if not known and len(self._parts) >= PARTS:
                raise XmFullError(
                    "too many files are being written",
                    where=self._rtpu,
                    expected=f"at most {PARTS}",
                    remedy="close those that are complete",
                )
            if not known and request.offset:
                raise _dropped(self._where(request.path))
            self._parts[key] = beside
        how = 0 if known else os.O_CREAT | os.O_EXCL
        try:
            with self._folder(beside, parent=True) as (fd, name):
                flags = os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC | how
                here = os.open(name, flags, 0o644, dir_fd=fd)
                try:
                    if request.offset > os.fstat(here).st_size:
                        raise _dropped(self._where(request.path))
                    _write_all(here, request.data, request.offset)
                finally:
                    os.close(here)
        except BaseException:
            self._drop(key)
            raise

    def _finish(self, request: f.FileFinish) -> None:
        beside, key = self._beside(request), (request.client, request.part)
        with self._guard:
            known = self._parts.get(key) == beside
        if not request.keep:
            self._drop(key)
            return
        if not known:
            raise _dropped(self._where(request.path))
        target = request.path.rstrip("/").rpartition("/")[2]
        try:
            with self._folder(beside, parent=True) as (fd, name):
                here = os.open(name, os.O_RDONLY | os.O_NOFOLLOW, dir_fd=fd)
                try:
                    if os.fstat(here).st_size != request.size:
                        raise _dropped(self._where(request.path))
                    os.fsync(here)
                finally:
                    os.close(here)
                if request.fresh:
                    os.link(
                        name,
                        target,
                        src_dir_fd=fd,
                        dst_dir_fd=fd,
                        follow_symlinks=False,
                    )
                else:
                    os.rename(name, target, src_dir_fd=fd, dst_dir_fd=fd)
        finally:
            self._drop(key)

    def _drop(self, key: tuple[str, str]) -> None:
        with self._guard:
            beside = self._parts.pop(key, None)
        if beside is not None:
            with (
                contextlib.suppress(XmError, OSError),
                self._folder(beside, parent=True) as (fd, name),
            ):
                os.unlink(name, dir_fd=fd)

    def _change(self, request: f.FileChange) -> None:
        do: dict[str, Callable[..., None]] = {
            "mkdir": os.mkdir,
            "rmdir": os.rmdir,
            "remove": os.unlink,
            "touch": partial(os.utime, follow_symlinks=False),
        }
        if request.what not in do or not request.path.strip("/."):
            raise XmNameError(
                "this change is not possible",
                where=self._where(request.path),
                expected=f"{', '.join(do)}, below the agent's folder",
                got=request.what[:20],
                remedy="give a path in the folder",
            )
        with self._folder(request.path, parent=request.what != "touch") as (fd, name):
            do[request.what](name, dir_fd=fd)

    def _move(self, request: f.FileMove) -> None:
        path, to = (self._real(p, parent=True)[1] for p in (request.path, request.to))
        if not path or not to or (to != path and to[: len(path)] == path):
            raise XmNameError(
                "this move is not possible",
                where=self._where(request.path),
                expected="two paths below the agent's folder, the second not in the "
                "first",
                got=repr(request.to[:100]),
                remedy="give two paths in the folder",
            )
        with self._folder(request.path, parent=True) as (fd, name):
            os.stat(name, dir_fd=fd, follow_symlinks=False)  # errors name the source
            with self._folder(request.to, parent=True) as (other, target):
                os.rename(name, target, src_dir_fd=fd, dst_dir_fd=other)


def _seen(name: str, found: os.stat_result) -> f.FileSeen:
    kind = "other"
    if stat.S_ISREG(found.st_mode):
        kind = "file"
    elif stat.S_ISDIR(found.st_mode):
        kind = "directory"
    return f.FileSeen(
        name=name,
        type=kind,
        size=found.st_size if kind == "file" else 0,
        mtime=found.st_mtime,
        inode=found.st_ino,
    )


def _write_all(fd: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        done = os.pwrite(fd, view, offset)
        view, offset = view[done:], offset + done


def _dropped(where: str) -> XmLapsedError:
    return XmLapsedError(
        "the incomplete file was discarded",
        where=where,
        got="a link that was lost meanwhile, or an agent that was restarted",
        remedy="write it again; an existing file is unchanged",
    )
