"""Files in the folders that agents declare, for the verb ``pbonet file``."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from contextlib import contextmanager
from datetime import UTC, datetime
from glob import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from msgspec import Struct

from pbonet.errors import ConfigFileError, PbonetError, XmError, XmNameError

if TYPE_CHECKING:
    from collections.abc import Generator


class Reach(Protocol):
    """Where agents are found."""

    @property
    def domain(self) -> str:
        """The domain."""
        ...

    @property
    def connect(self) -> tuple[str, ...]:
        """Endpoints of agents on other machines."""
        ...


class Entry(Struct, frozen=True, kw_only=True):
    """A file or folder of another machine."""

    name: str
    """``RTPU/PATH``."""
    type: str
    """``file``, ``directory`` or ``other``."""
    size: int
    """Bytes."""
    changed: str
    """When it was changed by its machine's clock, UTC; empty: not known."""


def entries(path: str, reach: Reach) -> list[Entry]:
    """Return what a folder holds; of the empty path the RTPUs.

    Raises:
        XmMissingError: There is no such file or folder.
        UnreachableError: The RTPU cannot be reached.
    """
    with _files(reach) as files:
        return [_entry(one) for one in files.ls(path.rstrip("/"))]


def _entry(one: dict[str, Any]) -> Entry:
    when = one.get("mtime")
    changed = (
        datetime.fromtimestamp(when, UTC).isoformat(timespec="seconds") if when else ""
    )
    return Entry(
        name=one["name"], type=one["type"], size=one["size"] or 0, changed=changed
    )


def put(file: Path, path: str, reach: Reach, *, recursive: bool = False) -> str:
    """Copy a file or folder to a machine; return its path there.

    Raises:
        ConfigFileError: It cannot be read here, or it is a folder without `recursive`.
        XmError: It cannot be written there.
    """
    _must_be_there(file, recursive=recursive)
    if path.endswith("/"):
        path = f"{path.rstrip('/')}/{file.resolve().name}"
    _must_name_a_path(path)
    with _files(reach) as files:
        if not recursive and files.isdir(path):
            path = f"{path}/{file.name}"
        if file.is_dir():
            files.put(f"{escape(str(file))}/", f"{path}/", recursive=True)
            return path
        parent = path.rpartition("/")[0]
        if "/" in parent:
            files.makedirs(parent, exist_ok=True)
        with file.open("rb") as source, files.open(path, "wb") as target:
            shutil.copyfileobj(source, target, 1 << 19)
    return path


def get(path: str, file: Path, reach: Reach, *, recursive: bool = False) -> Path:
    """Copy a file or folder from a machine; return its path here.

    Raises:
        XmMissingError: There is no such file.
        XmError: It is a folder without `recursive`, or cannot be read.
        ConfigFileError: It cannot be written here.
    """
    _must_name_a_path(path)
    with _files(reach) as files:
        folder = files.info(path)["type"] == "directory"
        if folder and not recursive:
            raise _is_folder(path)
        if file.is_dir() and not folder:
            file /= path.rstrip("/").rpartition("/")[2]
        if folder:
            files.get(f"{escape(path.rstrip('/'))}/", f"{file}/", recursive=True)
            return file
        with _whole(file) as target, files.open(path, "rb") as source:
            shutil.copyfileobj(source, target, 1 << 19)
    return file


def remove(path: str, reach: Reach, *, recursive: bool = False) -> None:
    """Remove a file, a link, or a folder.

    Raises:
        XmMissingError: There is none.
        XmError: It is a folder that is not empty, without `recursive`.
    """
    _must_name_a_path(path)
    with _files(reach) as files:
        files.rm_exactly(path.rstrip("/"), recursive=recursive)


@contextmanager
def _files(reach: Reach) -> Generator[Any]:
    """Yield the file system of all machines; what fails here is an error with a remedy.

    Raises:
        PbonetError: `fsspec` is not installed.
        ConfigFileError: A file of this machine cannot be read or written.
    """
    try:
        fsspec: Any = import_module("fsspec")
    except ImportError as error:
        raise PbonetError(
            "files of other machines need a package that does not import",
            got=str(error),
            remedy="pip install 'pbonet[files]'",
        ) from None
    files = fsspec.filesystem(
        "pbonet", domain=reach.domain, connect=reach.connect, skip_instance_cache=True
    )
    try:
        yield files
    except OSError as error:
        if isinstance(error, PbonetError):
            raise
        raise _local(error, str(error.filename or "")) from None
    finally:
        files.close()


def _must_name_a_path(path: str) -> None:
    if not path.partition("/")[2]:
        raise XmNameError(
            "this names no file of an RTPU",
            expected="RTPU/PATH",
            got=repr(path),
            remedy="'pbonet file ls' shows the RTPUs",
        )


def _must_be_there(file: Path, *, recursive: bool) -> None:
    if file.is_dir() and not recursive:
        raise ConfigFileError(
            "this is a folder",
            where=str(file),
            expected="a file",
            remedy="copy a folder with --recursive",
        )
    if not file.exists():
        raise ConfigFileError(
            "there is no such file",
            where=str(file),
            remedy="correct the name",
        )


def _is_folder(path: str) -> XmError:
    return XmError(
        "this is a folder",
        where=path,
        expected="a file",
        remedy="copy a folder with --recursive",
    )


# -- files of this machine ------------------------------------------------------------


def read_bytes(file: str) -> bytes:
    """Return what a file holds; ``-`` is standard input.

    Raises:
        ConfigFileError: It cannot be read.
    """
    if file == "-":
        return sys.stdin.buffer.read()
    try:
        return Path(file).read_bytes()
    except OSError as error:
        raise _local(error, file) from None


def must_be_writable(file: Path) -> None:
    """Check that a file can be written.

    Raises:
        ConfigFileError: It cannot.
    """
    try:
        with file.open("ab"):
            pass
    except OSError as error:
        raise _local(error, str(file)) from None


def write_bytes(file: Path, data: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        ConfigFileError: It cannot be written.
    """
    try:
        with _whole(file) as target:
            target.write(data)
    except OSError as error:
        raise _local(error, str(file)) from None


@contextmanager
def _whole(file: Path) -> Generator[Any]:
    """Yield a stream whose content is in the file when the block has ended well.

    A device, a pipe or a link stays what it is, and is written at once.
    """
    if file.is_symlink() or (file.exists() and not file.is_file()):
        with file.open("wb") as stream:
            yield stream
        return
    if not file.parent.is_dir():
        raise ConfigFileError(
            "there is no such folder",
            where=str(file.parent),
            remedy="make it, or name another one",
        )
    handle, name = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream
        mask = os.umask(0)
        os.umask(mask)
        Path(name).chmod(0o666 & ~mask)
        Path(name).replace(file)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _local(error: OSError, file: str) -> ConfigFileError:
    return ConfigFileError(
        "a file of this machine cannot be used",
        where=file,
        got=error.strerror or str(error),
        remedy="name one that is there, in a folder that is writable",
    )
