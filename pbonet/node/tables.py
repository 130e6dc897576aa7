"""The state variable tables that an RTPU has open, one per subsystem (section 4.5.1).

On each machine a subsystem has one table. The RTPU process of the keeper makes it and
removes it; others on that machine attach. On other machines the first one makes it, and
agents carry what changes from one to the other. When the keeper is gone, or elsewhere,
whoever lets go last removes the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from pbonet.config import parse_svar
from pbonet.errors import (
    SvarDamagedError,
    SvarError,
    SvarExistsError,
    SvarLayoutError,
    SvarMissingError,
)
from pbonet.svar import Flags, Table
from pbonet.xm import rundir
from pbonet.xm.messages import TableInfo, VarValue
from pbonet.xm.values import plain

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pbonet.config.model import SvarFile
    from pbonet.svar import LocalTable
    from pbonet.xm.messages import OpenTable


class Opened(Struct):
    """A table and what it was made from."""

    table: Table
    file: SvarFile
    keep: bool
    missed: bool = False
    """True once its file was found to be gone or truncated."""


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

    def kept(self) -> dict[str, bool]:
        """Return by subsystem whether this RTPU keeps the open table."""
        return {name: opened.keep for name, opened in self._open.items()}

    def get(self, subsystem: str) -> Opened | None:
        """Return the subsystem's table if it is open."""
        return self._open.get(subsystem)

    def sound(self, subsystem: str) -> Opened | None:
        """Return the subsystem's table if it is open, and its file whole."""
        return None if self.cut(subsystem) else self._open.get(subsystem)

    def need(self, subsystem: str) -> Opened:
        """Return the subsystem's table.

        Raises:
            SvarMissingError: It is not open.
            SvarDamagedError: Its file was truncated.
        """
        opened = self._open.get(subsystem)
        if opened is None:
            raise SvarMissingError(
                f"the table of subsystem {subsystem!r} is not open here",
                remedy="the master opens it when it starts the subsystem",
            )
        opened.table.must_be_whole()
        return opened

    def need_file(self, subsystem: str) -> Opened:
        """Return the subsystem's table, sure that tasks can attach to it.

        Raises:
            SvarMissingError: It is not open, or its file was removed.
            SvarDamagedError: Its file was truncated.
        """
        opened = self.need(subsystem)
        if not opened.table.path.exists():
            raise SvarMissingError(
                "the table's file was removed while it was in use",
                where=str(opened.table.path),
                remedy="tasks that run go on; stop the subsystem and start it again "
                "before spawning more",
            )
        return opened

    def open(self, request: OpenTable) -> TableInfo:
        """Create or attach the subsystem's table.

        Raises:
            ConfigError: The text of the file is wrong.
            SvarError: The table cannot be made, or stands with another layout.
        """
        rundir.check_name("a subsystem", request.subsystem)
        file = parse_svar(request.svar, request.svar_name)
        layout = Table.layout_of(file.variables)
        name = f"{self._domain}.{request.subsystem}"
        held = self._open.get(request.subsystem)
        if held is not None:
            if held.table.layout != layout:
                raise _other_layout(name, layout, held.table.layout)
            return self._info(held)
        table = self._create(name, file) if request.keep else self._attach(name, file)
        opened = Opened(table, file, request.keep)
        self._open[request.subsystem] = opened
        self._changed()
        return self._info(opened)

    def close(self, subsystem: str) -> None:
        """Let go of the table; the keeper removes its file."""
        opened = self._open.pop(subsystem, None)
        if opened is None:
            return
        if opened.keep:
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
            Each with how it was truncated; with no text where it was removed.
        """
        found: list[tuple[str, str]] = []
        for subsystem, opened in self._open.items():
            if opened.missed:
                continue
            cut = self.cut(subsystem)
            if cut or not opened.table.path.exists():
                opened.missed = True
                found.append((subsystem, cut))
        return found

    def cut(self, subsystem: str) -> str:
        """Return how a subsystem's table was truncated; empty when it was not."""
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

    def display(self, subsystem: str, names: Sequence[str] | None) -> list[VarValue]:
        """Return values of variables with their provenance, without owning any.

        All values are those of one instant; where that is not proven, they say so.

        Raises:
            UnknownVariableError: The table has no variable of that name.
            SvarDamagedError: Its file was truncated.
        """
        table = self.need(subsystem).table
        wanted = list(names or table.names())
        with table.local("display", os.getpid(), invar=wanted) as local:
            flags = local.copy_in()
            if flags & Flags.COPY_LOST:
                return [_value(table, name) for name in wanted]
            whole = not flags & Flags.COPY_TORN
            values = [_of_cut(table, local, name, whole=whole) for name in wanted]
        table.must_be_whole()  # else zeros were read for values
        return values

    def write(self, subsystem: str, name: str, values: Sequence[float]) -> VarValue:
        """Set a variable that no task writes.

        Raises:
            SvarOwnerError: A task writes it.
            SvarError: This RTPU is not the keeper, or the values do not fit.
        """
        opened = self.need(subsystem)
        if not opened.keep:
            raise SvarError(
                "this RTPU does not keep the table",
                where=opened.table.name,
                remedy="send it to the RTPU that MASTER names, or the first one",
            )
        opened.table.write(name, values)
        return _value(opened.table, name)

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

    @staticmethod
    def _info(opened: Opened) -> TableInfo:
        return TableInfo(
            name=opened.table.name,
            layout=opened.table.layout,
            machine=rundir.machine(),
        )


def remove_unused(path: Path) -> bool:
    """Remove a table's file unless somebody is attached; return whether it is gone.

    Whoever is attached holds a shared lock on the file.
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
        "a table of this name stands with another layout",
        where=name,
        expected=f"layout {wanted}",
        got=f"layout {got}",
        remedy="stop the subsystem that uses it, or give this one another name",
    )


def _value(table: Table, name: str) -> VarValue:
    """Return a variable by itself."""
    info = table.info(name)
    return _shown(table, name, table.read(name), stale=info.stale, whole=False)


def _of_cut(table: Table, local: LocalTable, name: str, *, whole: bool) -> VarValue:
    """Return a variable as it stood in a copy of several."""
    stale = local.stale(name)
    return _shown(table, name, local.array(name), stale=stale, whole=whole)


def _shown(
    table: Table, name: str, value: NDArray[Any], *, stale: bool, whole: bool
) -> VarValue:
    variable = table.variable(name)
    info = table.info(name)
    return VarValue(
        name=name,
        index=table.index(name),
        values=plain(value),
        units=variable.units,
        desc=variable.desc,
        writer=info.writer,
        age=None if info.age_ns is None else info.age_ns * 1e-9,
        cycle=info.cycle,
        seq=info.seq,
        stale=stale,
        whole=whole,
    )
