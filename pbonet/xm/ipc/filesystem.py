"""Files of other machines as an fsspec file system: ``pbonet://RTPU/PATH``.

fsspec, numpy, MCAP readers and others can use it (Stewart 1994, section 5.3.2). Paths
are relative to the folder that the RTPU's agent declares. A file that is written
appears as a whole when it is closed, or not at all.
"""

# fsspec's classes do not declare their attributes.
# pyright: basic, reportIncompatibleMethodOverride=false, reportArgumentType=false

from __future__ import annotations

import contextlib
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pbonet.errors import (
    PbonetError,
    XmAccessError,
    XmError,
    XmExistsError,
    XmMissingError,
    XmNameError,
)
from pbonet.outside import refuse
from pbonet.xm.net import file_messages as f

from . import names, remote_channel

try:
    from fsspec.spec import AbstractBufferedFile, AbstractFileSystem
except ImportError as error:  # pragma: no cover - only without the extra `files`
    raise ImportError(
        "files of other machines need fsspec: pip install 'pbonet[files]'"
    ) from error

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.xm.net import XmRequest

T = TypeVar("T")

ANSWER_TIME = 5.0
"""Seconds within which an agent reads or writes a part of a file."""
DEEPEST = 64
"""Maximum depth of a path in folders; symbolic links may form a cycle."""


class PbonetFileSystem(AbstractFileSystem):  # type: ignore[misc]
    """Files on the machines of RTPUs.

    Errors are those of `pbonet.errors`, of classes that also inherit the builtin ones
    (`FileNotFoundError` and others) where fsspec expects them.

    Args:
        domain: The domain of the RTPUs; by default this process's own.
        connect: Endpoints of agents; by default those of `PBONET_CONNECT` and of this
            machine.
        keys: A key folder; by default the one in `PBONET_KEYS`.
        options: Options of every fsspec file system.
    """

    protocol = "pbonet"
    root_marker = ""
    cachable = True

    def __init__(
        self,
        domain: str | None = None,
        connect: Sequence[str] | str = (),
        keys: str | None = None,
        **options: Any,  # noqa: ANN401 - fsspec's
    ) -> None:
        super().__init__(**options)
        self._carrier: remote_channel.Carrier | None = None
        if domain or connect or keys:
            endpoints = connect.split() if isinstance(connect, str) else connect
            self._carrier = remote_channel.client(
                domain or names.home().domain,
                connect=endpoints,
                key_folder=Path(keys) if keys else None,
            )

    def ask(self, path: str, request: XmRequest, result: type[T]) -> T:
        """Return an agent's answer to a request; `path` begins with the RTPU."""
        refuse(f"the file pbonet://{path}")
        carrier = self._carrier or remote_channel.carrier()
        rtpu = _split(path)[0]
        return carrier.call(rtpu, request, result, timeout=ANSWER_TIME)

    def close(self) -> None:
        """Close the connection, if this object has its own."""
        if self._carrier is not None:
            self._carrier.close()

    # -- reading -----------------------------------------------------------------------

    def info(self, path: str, **_: object) -> dict[str, Any]:
        """Return the entry at a path: `name`, `type`, `size` (bytes), `mtime` (s)."""
        path = str(self._strip_protocol(path))
        if not path:
            return {"name": "", "type": "directory", "size": 0}
        found = self.ask(path, f.FileStat(path=_split(path)[1]), f.FileSeen)
        return _entry(path, found)

    def exists(self, path: str, **_: object) -> bool:
        """Return whether something exists at a path.

        Raises:
            UnreachableError: The RTPU cannot be reached, so the answer is unknown.
        """
        return self._type(path) != ""

    def isdir(self, path: str) -> bool:
        """Return whether a folder exists at a path; raises as `exists`."""
        return self._type(path) == "directory"

    def isfile(self, path: str) -> bool:
        """Return whether a file exists at a path; raises as `exists`."""
        return self._type(path) == "file"

    def _type(self, path: str) -> str:
        """Return the type of the entry at a path; empty if there is none.

        fsspec would report an unreachable RTPU as a missing file.
        """
        try:
            return str(self.info(path)["type"])
        except XmError:
            return ""

    def ls(self, path: str, detail: bool = True, **_: object) -> list[Any]:  # noqa: FBT001, FBT002 - fsspec's
        """Return the entries of a folder; of the root the RTPUs that are alive."""
        path = str(self._strip_protocol(path))
        if not path:
            found = [
                {"name": name, "type": "directory", "size": 0}
                for name in (self._carrier or remote_channel.carrier()).rtpus()
            ]
        else:
            found = self._held(path)
        return found if detail else [one["name"] for one in found]

    def _held(self, path: str) -> list[dict[str, Any]]:
        if self.info(path)["type"] != "directory":
            return [self.info(path)]
        below, found, after = _split(path)[1], list[dict[str, Any]](), ""
        while True:
            page = self.ask(path, f.FileList(path=below, after=after), f.Listing)
            found += [_entry(f"{path}/{one.name}", one) for one in page.entries]
            if not page.more:
                return found
            after = page.last

    def modified(self, path: str) -> datetime:
        """Return when a file was changed, by its machine's clock."""
        return datetime.fromtimestamp(self.info(path)["mtime"], UTC)

    # -- changing ----------------------------------------------------------------------

    def mkdir(self, path: str, create_parents: bool = True, **_: object) -> None:  # noqa: FBT001, FBT002 - fsspec's
        """Make a folder."""
        path = str(self._strip_protocol(path))
        if create_parents and _split(path)[1].count("/"):
            self.makedirs(str(self._parent(path)), exist_ok=True)
        self._change(path, "mkdir")

    def makedirs(self, path: str, exist_ok: bool = False) -> None:  # noqa: FBT001, FBT002 - fsspec's
        """Make a folder and its parents."""
        path = str(self._strip_protocol(path))
        parts = [part for part in _split(path)[1].split("/") if part]
        for count in range(1, len(parts) + 1):
            try:
                self._change("/".join([_split(path)[0], *parts[:count]]), "mkdir")
            except XmExistsError:
                if count == len(parts) and not (exist_ok and self.isdir(path)):
                    raise

    def _make_parent(self, path: str) -> None:
        """Make the folder of a path, if there is none."""
        parent = str(self._parent(path))
        try:
            self.info(parent)
        except XmMissingError:
            self.makedirs(parent, exist_ok=True)

    def touch(self, path: str, truncate: bool = True, **options: Any) -> None:  # noqa: FBT001, FBT002, ANN401 - fsspec's
        """Make an empty file; without `truncate` an existing one gets a new time."""
        path = str(self._strip_protocol(path))
        if truncate or not self.exists(path):
            self._make_parent(path)
            self.pipe_file(path, b"", **options)
        else:
            self._change(path, "touch")

    def rm(
        self,
        path: str | list[str],
        recursive: bool = False,  # noqa: FBT001, FBT002 - fsspec's
        maxdepth: int | None = None,
    ) -> None:
        """Remove files, and folders with their content if `recursive`.

        A symbolic link is removed, never its target.
        """
        for one in self.expand_path(path):
            self._remove(one, deeper=(maxdepth or DEEPEST) if recursive else 0)

    def rm_exactly(self, path: str, *, recursive: bool = False) -> None:
        """Remove what has this name as `rm` does, without patterns such as ``*``."""
        path = str(self._strip_protocol(path))
        self._remove(path, deeper=DEEPEST if recursive else 0)

    def _remove(self, path: str, deeper: int) -> None:
        if deeper and self._is_folder(path):
            for one in self.ls(path, detail=False):
                self._remove(one, deeper - 1)
        self.rm_file(path)

    def _is_folder(self, path: str) -> bool:
        """Return whether the entry at a path is a folder and not a link to one."""
        with contextlib.suppress(XmError):
            found = self.info(path)
            return found["type"] == "directory" and not found.get("islink")
        return False

    def rm_file(self, path: str) -> None:
        """Remove a file, a link, or an empty folder."""
        what = "rmdir" if self._is_folder(path) else "remove"
        self._change(str(self._strip_protocol(path)), what)

    _rm = rm_file

    def cp_file(self, path1: str, path2: str, **_: object) -> None:
        """Copy a file, also from one RTPU to another; of a folder make an empty one.

        The copy appears when it is complete. The data passes through this process.
        """
        path1, path2 = (str(self._strip_protocol(path)) for path in (path1, path2))
        if self.isdir(path1):
            self.makedirs(path2, exist_ok=True)
            return
        with self.open(path1, cache_type="none") as source:
            self._make_parent(path2)
            with self.open(path2, "wb") as copy:
                shutil.copyfileobj(source, copy, f.CHUNK)

    def mv(
        self,
        path1: str | list[str],
        path2: str | list[str],
        **_: object,
    ) -> None:
        """Move files and whole folders, into `path2` if that is a folder.

        On one RTPU each is moved atomically. From one RTPU to another it is copied, and
        removed when the copy is complete. A file at the new path is replaced.

        Raises:
            XmExistsError: A folder at the new path on another RTPU is in the way.
        """
        if isinstance(path2, list):
            pairs = list(
                zip([path1] if isinstance(path1, str) else path1, path2, strict=True)
            )
        else:
            sources: list[str] = self.expand_path(path1)
            into = len(sources) > 1 or path2.endswith("/") or self.isdir(path2)
            pairs = [
                (one, f"{path2}/{one.rpartition('/')[2]}" if into else path2)
                for one in sources
            ]
        for source, target in pairs:
            self._move(*(str(self._strip_protocol(one)) for one in (source, target)))

    def _move(self, source: str, target: str) -> None:
        if source == target:
            return
        (rtpu, path), (other, to) = _split(source), _split(target)
        if rtpu == other:
            try:
                self.ask(source, f.FileMove(path=path, to=to), type(None))
            except XmMissingError:  # of the source, or of the target's folder
                if not self._is_listed(source):
                    raise
                self._make_parent(target)
                self.ask(source, f.FileMove(path=path, to=to), type(None))
            return
        if self.isdir(target):
            raise XmExistsError(
                "there is a folder at the new path",
                where=f"pbonet://{target}",
                remedy="remove it first, or choose another name",
            )
        whole = self.isdir(source)
        self.copy(source, target, recursive=whole, on_error="raise")
        self.rm(source, recursive=whole)

    def _is_listed(self, path: str) -> bool:
        """Return whether something exists at a path, even a dangling link."""
        with contextlib.suppress(XmMissingError):
            return path in self.ls(str(self._parent(path)), detail=False)
        return False

    def rmdir(self, path: str) -> None:
        """Remove an empty folder."""
        self._change(str(self._strip_protocol(path)), "rmdir")

    def _change(self, path: str, what: str) -> None:
        request = f.FileChange(path=_split(path)[1], what=what)
        self.ask(path, request, type(None))

    def _open(
        self,
        path: str,
        mode: str = "rb",
        block_size: int | str | None = None,
        autocommit: bool = True,  # noqa: FBT001, FBT002 - fsspec's
        cache_options: dict[str, Any] | None = None,
        **options: Any,  # noqa: ANN401 - fsspec's
    ) -> PbonetFile:
        return PbonetFile(
            self,
            path,
            mode,
            f.CHUNK if block_size is None else block_size,
            autocommit,
            cache_options=cache_options,
            **options,
        )


class PbonetFile(AbstractBufferedFile):  # type: ignore[misc]
    """A file on another machine."""

    DEFAULT_BLOCK_SIZE: ClassVar[int] = f.CHUNK

    def __init__(
        self,
        fs: PbonetFileSystem,
        path: str,
        mode: str,
        block_size: int | str,
        autocommit: bool,  # noqa: FBT001 - fsspec's
        **options: Any,  # noqa: ANN401 - fsspec's
    ) -> None:
        if mode not in {"rb", "wb", "xb"}:
            raise XmAccessError(
                "a file on another machine is read or written as a whole",
                where=path,
                expected="mode rb, wb or xb",
                got=mode,
                remedy="read it and write it again, or write another file",
            )
        if mode == "xb" and fs.exists(path):  # the agent checks again at the end
            raise XmExistsError(
                "there is already a file at this path",
                where=f"pbonet://{path}",
                remedy="choose another name, or mode wb to replace it",
            )
        self._part = os.urandom(8).hex()
        self._written = 0
        super().__init__(fs, path, mode, block_size, autocommit, **options)
        if mode == "rb" and self.details["type"] != "file":
            raise XmAccessError(
                "this is not a regular file",
                where=path,
                got=self.details["type"],
                remedy="read files, list folders",
            )

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the file; after an exception what was written is discarded."""
        if kind is not None and self.mode != "rb":
            self.discard()
        self.close()

    def _fetch_range(self, start: int, end: int) -> bytes:
        got = bytearray()
        while start + len(got) < end:
            request = f.FileRead(
                path=_split(self.path)[1],
                offset=start + len(got),
                size=min(end - start - len(got), f.CHUNK),
                inode=self.details["inode"],
            )
            part = self.fs.ask(self.path, request, bytes)
            if not part:
                break
            got += part
        return bytes(got)

    def _initiate_upload(self) -> None:
        self._written = 0
        self._send(b"")

    def _upload_chunk(self, final: bool = False) -> bool:  # noqa: FBT001, FBT002 - fsspec's
        data = self.buffer.getvalue()
        for begin in range(0, len(data), f.CHUNK):
            self._send(data[begin : begin + f.CHUNK])
        if final and self.autocommit:
            self.commit()
        return True

    def _send(self, data: bytes) -> None:
        request = f.FileWrite(
            path=_split(self.path)[1], part=self._part, offset=self._written, data=data
        )
        try:
            self.fs.ask(self.path, request, type(None))
        except BaseException:
            self.discard()
            raise
        self._written += len(data)

    def commit(self) -> None:
        """Move the file to its place."""
        self._finish(keep=True)

    def discard(self) -> None:
        """Discard what was written."""
        self.forced = True  # nothing is left to send when it is closed
        with contextlib.suppress(PbonetError):  # the agent discards it anyway
            self._finish(keep=False)

    def _finish(self, *, keep: bool) -> None:
        request = f.FileFinish(
            path=_split(self.path)[1],
            part=self._part,
            size=self._written,
            keep=keep,
            fresh=self.mode == "xb",
        )
        self.fs.ask(self.path, request, type(None))


def _split(path: str) -> tuple[str, str]:
    """Return RTPU and path of ``RTPU/PATH``."""
    rtpu, _, below = path.partition("/")
    if not rtpu:
        raise XmNameError(
            "the path names no RTPU",
            expected="pbonet://RTPU/PATH",
            got=repr(path[:100]),
            remedy="list pbonet:// for the RTPUs that can be reached",
        )
    return rtpu, below


def _entry(path: str, found: f.FileSeen) -> dict[str, Any]:
    return {
        "name": path,
        "type": found.type,
        "size": found.size,
        "mtime": found.mtime,
        "inode": found.inode,
        "islink": found.link,
    }
