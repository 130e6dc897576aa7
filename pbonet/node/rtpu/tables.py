"""The state variable tables that an RTPU has open, one per subsystem (section 4.5.1).

On each machine a subsystem has one table. The RTPU process of the keeper makes it and
removes it; others on that machine attach. On other machines the first one makes it, and
agents carry what changes from one to the other. When the keeper is gone, or elsewhere,
the last process that detaches removes the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.config import parse_svar
from pbonet.errors import (
    SvarDamagedError,
    SvarExistsError,
    SvarLayoutError,
    SvarMissingError,
)
from pbonet.node.wire import rtpu_messages
from pbonet.svar import Table
from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pbonet.config import SvarFile
    from pbonet.xm.net import Claim


_LOCK = struct.Struct("hhqqi4x")


class Opened(Struct):
    """A table and what it was made from."""

    table: Table
    file: SvarFile
    use: rtpu_messages.OpenTable
    missed: bool = False
    """True once its file was found to be gone or damaged."""


class Tables:
    """The open tables of one RTPU process.

    Args:
        domain: Part of every table's name, so that domains do not meet.
        changed: Called when a table was opened or let go.
    """

    def __init__(self, domain: str, *, changed: Callable[[], None]) -> None:
        self._domain = domain
        self._changed = changed
        self._open: dict[str, Opened] = {}

    def names(self) -> list[str]:
        """Return the names of the open tables, as their files bear them."""
        return [opened.table.name for opened in self._open.values()]

    def subsystems(self) -> list[str]:
        """Return the subsystems whose tables are open."""
        return list(self._open)

    def uses(self) -> dict[str, rtpu_messages.OpenTable]:
        """Return by subsystem how this RTPU uses the open table."""
        return {name: opened.use for name, opened in self._open.items()}

    def get(self, subsystem: str) -> Opened | None:
        """Return the subsystem's table if it is open."""
        return self._open.get(subsystem)

    def sound(self, subsystem: str) -> Opened | None:
        """Return the subsystem's table if it is open, and its file not damaged."""
        return None if self.damage(subsystem) else self._open.get(subsystem)

    def need(self, subsystem: str) -> Opened:
        """Return the subsystem's table.

        Raises:
            SvarMissingError: It is not open.
            SvarDamagedError: Its file was truncated or overwritten.
        """
        opened = self._open.get(subsystem)
        if opened is None:
            raise no_table(subsystem)
        opened.table.must_be_whole()
        return opened

    def need_file(self, subsystem: str) -> Opened:
        """Return the subsystem's table, sure that tasks can attach to it.

        Raises:
            SvarMissingError: It is not open, or its file was removed.
            SvarDamagedError: Its file was truncated or overwritten.
        """
        opened = self.need(subsystem)
        if not opened.table.path.exists():
            raise SvarMissingError(
                "the table's file was removed while it was in use",
                where=str(opened.table.path),
                remedy="running tasks continue; stop the subsystem and start it again "
                "before spawning more",
            )
        return opened

    def judge(self, request: Claim) -> SvarFile:
        """Return what the file of a table says, and change nothing.

        Raises:
            ConfigError: The text of the file is wrong.
            SvarLayoutError: The table is open with another layout.
        """
        run_folder.check_name("a subsystem", request.subsystem)
        file = parse_svar(request.svar, request.svar_name)
        held = self._open.get(request.subsystem)
        layout = Table.layout_of(file.variables)
        if held is not None and held.table.layout != layout:
            name = table_name(self._domain, request.subsystem)
            raise _other_layout(name, layout, held.table.layout)
        return file

    def open(self, request: Claim) -> None:
        """Create or attach the subsystem's table.

        Raises:
            ConfigError: The text of the file is wrong.
            SvarError: The table cannot be made, or exists with another layout.
        """
        file = self.judge(request)
        use = rtpu_messages.OpenTable(request.keep, request.keeper, request.alone)
        if (opened := self._open.get(request.subsystem)) is not None:
            if opened.use != use:
                opened.use = use
                self._changed()
            return
        name = table_name(self._domain, request.subsystem)
        table = self._create(name, file) if request.keep else self._attach(name, file)
        self._open[request.subsystem] = Opened(table, file, use)
        self._changed()

    def close(self, subsystem: str) -> None:
        """Let go of the table; the keeper removes its file."""
        opened = self._open.pop(subsystem, None)
        if opened is None:
            return
        if opened.use.keep:
            opened.table.destroy()
        else:
            path = opened.table.path
            opened.table.close()
            remove_unused(path)
        self._changed()

    def close_all(self) -> None:
        """Let go of every table; a file that others use is left to them."""
        for opened in self._open.values():
            path = opened.table.path
            opened.table.close()
            remove_unused(path)
        self._open.clear()
        self._changed()

    def harmed(self) -> list[tuple[str, str]]:
        """Return the subsystems whose table's file was harmed since the last call.

        Returns:
            Each with its damage; with no text where the file was removed.
        """
        found: list[tuple[str, str]] = []
        for subsystem, opened in self._open.items():
            if opened.missed:
                continue
            damage = self.damage(subsystem)
            if damage or not opened.table.path.exists():
                opened.missed = True
                found.append((subsystem, damage))
        return found

    def damage(self, subsystem: str) -> str:
        """Return how a subsystem's table was truncated or overwritten; empty: not."""
        opened = self._open.get(subsystem)
        if opened is not None:
            try:
                opened.table.must_be_whole()
            except SvarDamagedError as error:
                return str(error)
        return ""

    def causes(self, subsystem: str) -> list[str]:
        """Return why the illegal-configuration flag is up; empty while it is down."""
        names = [subsystem] if subsystem else self.subsystems()
        opened = [self._open[name] for name in names if name in self._open]
        return [
            f"{cause.cause} ({cause.raiser})"
            for one in opened
            for cause in one.table.illegal
        ]

    def _create(self, name: str, file: SvarFile) -> Table:
        try:
            return Table.create(name, file.variables)
        except SvarExistsError:
            return self._attach(name, file)

    def _attach(self, name: str, file: SvarFile) -> Table:
        """Attach to the machine's table; make it when the keeper is on another one."""
        try:
            return Table.attach(name, layout=Table.layout_of(file.variables))
        except SvarMissingError:
            return self._create(name, file)


def table_name(domain: str, subsystem: str) -> str:
    """Return the name of a subsystem's table, as its file bears it."""
    return f"{domain}.{subsystem}"


def no_table(subsystem: str) -> SvarMissingError:
    """Return the error for a subsystem whose table is not open."""
    return SvarMissingError(
        f"the table of subsystem {subsystem!r} is not open here",
        remedy="the master opens it when it starts the subsystem",
    )


def lock_to_carry(path: Path) -> int:
    """Lock a table's file, as one agent of a machine may while it lives.

    Returns:
        The descriptor that holds the lock; -1 if another agent has it.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return -1
    try:
        whole = _LOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, whole)
    except OSError:
        os.close(fd)
        return -1
    return fd


def remove_unused(path: Path) -> bool:
    """Remove a table's file unless a process is attached; return whether it is gone.

    Every attached process holds a shared lock on the file.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(fd), path.stat()):
                path.unlink()
    except BlockingIOError:
        return False
    finally:
        os.close(fd)
    return True


def _other_layout(name: str, wanted: str, got: str) -> SvarLayoutError:
    return SvarLayoutError(
        "a table of this name exists with another layout",
        where=name,
        expected=f"layout {wanted}",
        got=f"layout {got}",
        remedy="stop the subsystem that uses it, or give this one another name",
    )
