"""The files on disk: what saving would change in them, and saving it."""

from __future__ import annotations

import contextlib
import difflib
import errno
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import ConfigFileError

if TYPE_CHECKING:
    from collections.abc import Mapping


class FileChange(Struct, frozen=True, kw_only=True):
    """A change that saving makes to one file."""

    file: str
    kind: str
    """``new``, ``changed`` or ``removed``."""
    diff: str
    """A unified diff."""
    notes: list[str] = []


class SavedFiles:
    """Files as they were on disk when they were first read, and as they were saved."""

    def __init__(self) -> None:
        self._first: dict[Path, bytes | None] = {}
        self._now: dict[Path, bytes | None] = {}

    def note(self, path: Path) -> None:
        """Keep what a file holds now, unless it was kept before.

        Raises:
            ConfigFileError: It cannot be read.
        """
        if path not in self._first:
            self._first[path] = self._now[path] = _bytes(path)

    def is_new(self, path: Path) -> bool:
        """Return whether a file was not there when it was first looked for."""
        return path in self._first and self._first[path] is None

    def made(self) -> set[Path]:
        """Return the files that are there because they were saved here."""
        return {
            path
            for path, now in self._now.items()
            if now is not None and self._first[path] is None
        }

    def changes(self, texts: Mapping[Path, str]) -> dict[Path, bytes | None]:
        """Return what must be written; None: the file is to be removed.

        Args:
            texts: The files that are wanted; of others that were saved here, the first
                content is.
        """
        wanted: dict[Path, bytes | None] = {
            path: first
            for path, first in self._first.items()
            if first != self._now[path]
        }
        for path, text in texts.items():
            self.note(path)
            wanted[path] = _encoded(text, self._first[path])
        return {path: data for path, data in wanted.items() if data != self._now[path]}

    def described(
        self, texts: Mapping[Path, str], notes: Mapping[Path, list[str]]
    ) -> list[FileChange]:
        """Return what saving would do, with diffs."""
        found: list[FileChange] = []
        for path, data in self.changes(texts).items():
            before = self._now[path]
            kind = "changed" if before is not None else "new"
            found.append(
                FileChange(
                    file=str(path),
                    kind="removed" if data is None else kind,
                    diff=_diff(path, before or b"", data or b""),
                    notes=notes.get(path, []),
                )
            )
        return found

    def save(self, texts: Mapping[Path, str], last: Path) -> list[Path]:
        """Write what differs; each file is replaced as a whole, or stays.

        Args:
            texts: The files that are wanted.
            last: The one that is written after all others, which it names.

        Returns:
            The files that were written or removed.

        Raises:
            ConfigFileError: A file was changed meanwhile, and nothing was written; or
                one cannot be written, and the message says which were.
        """
        wanted = self.changes(texts)
        for path in wanted:
            self._must_be_as_known(path)
        done: list[Path] = []
        for path in sorted(wanted, key=lambda path: (path == last, str(path))):
            try:
                _replace(path, wanted[path])
            except OSError as error:
                raise ConfigFileError(
                    "the file cannot be written",
                    where=str(path),
                    got=error.strerror or str(error),
                    remedy=f"{_remedy(error)} and save again; saved before it: "
                    + (", ".join(map(str, done)) or "nothing"),
                ) from None
            self._now[path] = wanted[path]
            done.append(path)
        return done

    def _must_be_as_known(self, path: Path) -> None:
        """Refuse a file that another program has changed, made or removed.

        Raises:
            ConfigFileError: It is one.
        """
        before, now = self._now[path], _bytes(path)
        if before == now:
            return
        verb = "removed" if now is None else "changed" if before is not None else "made"
        raise ConfigFileError(
            f"another program {verb} the file since it was opened: nothing is saved",
            where=str(path),
            expected="the file as it was read"
            if before is not None
            else "no such file",
            remedy="keep a copy of it and bring the former state back, or open the job "
            "again and repeat the changes",
        )


def _bytes(path: Path) -> bytes | None:
    """Return what a file holds; None: it is not there.

    Raises:
        ConfigFileError: It cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigFileError(
            "the file cannot be read",
            where=str(path),
            got=error.strerror or str(error),
            remedy="check its permissions",
        ) from None


def _encoded(text: str, first: bytes | None) -> bytes:
    """Return a text as bytes; with a byte order mark if the file began with one."""
    mark = b"\xef\xbb\xbf"
    data = text.encode()
    return mark + data if first is not None and first.startswith(mark) else data


def _diff(path: Path, before: bytes, after: bytes) -> str:
    old, new = (
        data.decode("utf-8-sig", "replace").splitlines(keepends=True)
        for data in (before, after)
    )
    found = difflib.unified_diff(old, new, f"a/{path.name}", f"b/{path.name}")
    return "".join(line if line.endswith("\n") else f"{line}\n" for line in found)


def _remedy(error: OSError) -> str:
    if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}:
        return "make room on the disk"
    return "correct the permissions"


def _replace(path: Path, data: bytes | None) -> None:
    """Give a file another content at once, or remove it."""
    if data is None:
        path.unlink()
        return
    target = path.resolve()  # a link goes on naming its file
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=target.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        if target.exists():
            shutil.copymode(target, name)
        else:
            Path(name).chmod(0o666 & ~_umask())
        Path(name).replace(target)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(name).unlink()
        raise


def _umask() -> int:
    """Return the process's mask of permissions."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return int(text.partition("Umask:")[2].split()[0], 8)
