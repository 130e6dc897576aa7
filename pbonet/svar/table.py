"""The state variable table as one process sees it (Stewart 1994, section 5.5)."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet import shm
from pbonet.errors import (
    SvarError,
    SvarFullError,
    SvarOwnerError,
    UnknownVariableError,
    did_you_mean,
)

from . import guards, layout as lay, table_files
from ._svar import CAUSES, CAUSES_EACH, Arena, Blueprint, now_ns
from .local import LocalTable
from .result_codes import ALIVE, FULL, GONE, PASSED_ON, RIVAL, STUCK, Verdict
from .table_records import Cause, Register, VarInfo

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pbonet.config import Variable

SPARE = 4
"""How many more copies of the whole table fit into its arena besides the keeper's."""


class Table(shm.Closeable):
    """One subsystem's table on this machine; made by `create` or `attach`.

    Reading needs only access to the file. Tasks write through the `LocalTable` that
    `local` makes; an operator may set variables that no task owns.

    Args:
        name: The table's name.
        path: Its file.
        arena: The file, mapped.
    """

    def __init__(self, name: str, path: Path, arena: Arena) -> None:
        self.name = name
        self.path = path
        self._arena: Arena | None = arena
        self._variables = lay.decode(arena.text)
        self._index = {v.name: i for i, v in enumerate(self._variables)}
        self.virtual: Callable[[], int] | None = None
        """Returns the current time in nanoseconds if it is virtual; else None."""

    @classmethod
    def create(
        cls,
        name: str,
        variables: Sequence[Variable],
        *,
        spare: int = SPARE,
    ) -> Table:
        """Make a table with every variable at its INIT value (svarCreate).

        An existing file of that name without users was left by a crash and is replaced.

        Args:
            name: Part of the file's name.
            variables: The variables of the ``.svar`` file.
            spare: How many more copies of the whole table fit into the arena.

        Raises:
            SvarExistsError: A table of that name is in use.
            SvarLayoutError: The variables cannot form a table.
            SvarFullError: There is no room in shared memory.
        """
        lay.check_variables(variables)
        path = table_files.path_of(name)
        maxages = [round((v.maxage or 0.0) * 1e9) for v in variables]
        plan = Blueprint(
            array("Q", [lay.var_bytes(v) for v in variables]),
            array("q", maxages),
            lay.encode(variables),
            lay.layout_hash(variables),
            spare,
        )
        values = lay.initial_values(variables)
        fd, fresh = table_files.FILES.make(path, plan.size)
        try:
            arena = table_files.map_whole(path, fd, plan.size)
        except BaseException:
            fresh.unlink(missing_ok=True)
            raise
        if error := arena.format(plan, values):
            fresh.unlink(missing_ok=True)
            raise table_files.no_lock(path, error)
        table_files.FILES.publish(fresh, path)
        table_files.verify(path, arena, plan.size)
        return cls(name, path, arena)

    @classmethod
    def attach(cls, name: str, *, layout: str | None = None) -> Table:
        """Attach to an existing table (svarAttach).

        Args:
            name: The table's name.
            layout: Required value of its `layout`; None accepts any.

        Raises:
            SvarMissingError: There is no such table.
            SvarAccessError: It is another user's, or its permissions were changed.
            SvarDamagedError: It is not a table, truncated, or was overwritten.
            SvarLayoutError: It is of another version or another layout.
            SvarFullError: It cannot be mapped.
        """
        path = table_files.path_of(name)
        fd, size = table_files.open_file(path)
        arena = table_files.map_whole(path, fd, size)
        table_files.verify(path, arena, size)
        try:
            table = cls(name, path, arena)
        except msgspec.MsgspecError:
            raise table_files.damaged(path, Verdict.DAMAGED) from None
        table.must_be_whole()
        if layout is not None and table.layout != layout:
            raise table_files.other_layout(str(path), layout, table.layout)
        return table

    @staticmethod
    def layout_of(variables: Sequence[Variable]) -> str:
        """Return the value of `layout` of a table with these variables."""
        return lay.layout_hash(variables).hex()

    @property
    def layout(self) -> str:
        """Equal for compatible tables; DESC is not included."""
        return self._open().layout.hex()

    @property
    def generation(self) -> int:
        """A number that increases with every change of ownership."""
        return self._open().generation

    @property
    def variables(self) -> tuple[Variable, ...]:
        """All variables, in the order of their indices."""
        return self._variables

    def names(self) -> list[str]:
        """Return the names of all variables, in the order of their indices."""
        return list(self._index)

    def index(self, name: str) -> int:
        """Return the index of a variable (svarTranslate).

        Raises:
            UnknownVariableError: The table has no variable of that name.
        """
        try:
            return self._index[name]
        except KeyError:
            raise UnknownVariableError(
                f"the table has no variable {name}",
                where=self.name,
                remedy=did_you_mean(name, self._index)
                or "add it to the .svar file, or correct the alias",
            ) from None

    def variable(self, which: str | int) -> Variable:
        """Return the record of a variable, by name or index."""
        return self._variables[self._number(which)]

    def read(self, which: str | int) -> NDArray[Any]:
        """Return the newest value of a variable (svarRead, svarReadIx).

        Raises:
            UnknownVariableError: There is no variable of that name or index.
            SvarDamagedError: The table was overwritten.
        """
        return self.see(which)[0]

    def info(self, which: str | int) -> VarInfo:
        """Return who wrote a variable, when, and who owns it now."""
        return self.seen(which)[1]

    def written(self, which: str | int) -> bool:
        """Return whether a task writes a variable: one that lives and has not ended."""
        return self._open().written(self._number(which))

    def see(self, which: str | int) -> tuple[NDArray[Any], VarInfo]:
        """Return the newest value of a variable and its `info`, of one instant."""
        import numpy as np  # not in agents, which call `seen`

        data, info = self.seen(which)
        return np.frombuffer(data, self.variable(which).dtype), info

    def seen(self, which: str | int) -> tuple[array[Any], VarInfo]:
        """Return what `see` does, the value as `layout.elements` has it."""
        number = self._number(which)
        variable = self._variables[number]
        value, (_, live, time_ns, cycle, uid, seq, task) = self._read_raw(number)
        age = self._now() - time_ns if time_ns else None
        stale = variable.maxage is not None and (
            age is None or age > variable.maxage * 1e9
        )
        return value, VarInfo(
            owner=task if live else None,
            writer=task or None,
            time_ns=time_ns,
            age_ns=age,
            cycle=cycle & ~PASSED_ON,
            seq=seq,
            register=uid,
            stale=stale,
        )

    def write(
        self, which: str | int, values: Sequence[float] | bytes, *, wait: bool = True
    ) -> bool:
        """Set a variable that no task owns, as an operator does (svarWrite).

        Returns:
            Whether it was set; False without `wait` if the table is locked now.

        Raises:
            SvarOwnerError: A task owns it.
            SvarLayoutError: There are more or fewer values than elements, or they do
                not fit the type.
            SvarError: A value is not finite, or outside LIMIT.
        """
        number = self._number(which)
        variable = self._variables[number]
        value = guards.typed(self.name, variable, values).tobytes()
        room = _room(variable)
        room[: len(value)] = value
        code = self._open().set(number, room, self._now(), wait)
        if code == RIVAL:
            owner = self.info(number).owner
            raise SvarOwnerError(
                f"{variable.name} cannot be set: a task writes it",
                where=self.name,
                expected="a variable that no task owns",
                got=f"owner {owner}",
                remedy=f"turn {owner} off first",
            )
        if wait or code != STUCK:
            self._check_lock(code)
        return code != STUCK

    def peek(
        self, number: int, room: bytearray
    ) -> tuple[int, bool, int, int, int, int, str] | None:
        """Copy a variable into `room`, to send it to other machines.

        Args:
            number: Its index.
            room: Bytes of its size in a group.

        Returns:
            Register, whether a task owns it, time (ns), cycle, the register's uid, the
            commit's number, and task; None if no whole copy was possible.
        """
        return self._open().look(number, room)

    def put(self, number: int, data: bytes, time_ns: int) -> bool:
        """Set a variable to another machine's value; return whether it has no owner."""
        code = self._open().set(number, data, time_ns)
        self._check_lock(code)
        return code != RIVAL

    def local(
        self,
        task: str,
        pid: int,
        *,
        inconst: Sequence[str] = (),
        outconst: Sequence[str] = (),
        invar: Sequence[str] = (),
        outvar: Sequence[str] = (),
        keep: bool = False,
    ) -> LocalTable:
        """Make the local table of a task, with registers for what it writes.

        Args:
            task: The task's name.
            pid: The process that will write; after its death its claims can be taken.
            inconst: Variables read by `copy_in_consts`.
            outconst: Variables written by `copy_out_consts`.
            invar: Variables read by `copy_in`.
            outvar: Variables written by `commit`.
            keep: If a cut cannot be proven consistent, keep the last inputs instead of
                using groups that are whole each. Costs a second copy.

        Raises:
            UnknownVariableError: There is no such variable.
            SvarFullError: No register is free.
        """
        ports = [
            sorted({self.index(name) for name in names})
            for names in (inconst, outconst, invar, outvar)
        ]
        made = LocalTable.make(
            self._open(),
            self._variables,
            table=self.name,
            task=task,
            pid=pid,
            ports=ports,
            keep=keep,
        )
        if self.virtual is not None:
            made.virtual_ns = self.virtual()
        return made

    def _now(self) -> int:
        return now_ns() if self.virtual is None else self.virtual()

    def registers(self) -> list[Register]:
        """Return the registers and their holders; a recorder names writers by it.

        Raises:
            SvarError: The lock between claimers was not available in time.
            SvarDamagedError: The table was overwritten.
        """
        found = self._open().registers()
        if isinstance(found, int):
            raise table_files.locked_out(self.name, found)
        return [Register(*fields) for fields in found]

    def reap(self, owner: int | str) -> list[str]:
        """Free the claims of a task whose process has ended; its values remain.

        Its entries in the illegal-configuration flag are removed as well.

        Args:
            owner: `LocalTable.owner`, or the task's name.

        Returns:
            The variables that lost their owner.

        Raises:
            SvarOwnerError: The process still runs.
            SvarDamagedError: The file was truncated or overwritten.
        """
        arena = self._open()
        self.must_be_whole()
        held = [r for r in self.registers() if owner in {r.owner, r.task} and r.held]
        before = [arena.look(i, _room(v)) for i, v in enumerate(self._variables)]
        gone: set[int] = set()
        for register in held:
            code = arena.reap(register.index, register.uid)
            self._check_lock(code)
            if code != ALIVE:
                gone.add(register.uid)
        if held and not gone:
            raise SvarOwnerError(
                f"the claims of {held[0].task} remain, because its process runs",
                where=self.name,
                expected=f"process {held[0].pid} to have ended",
                remedy="turn the task off, or end the process first",
            )
        return [
            variable.name
            for variable, seen in zip(self._variables, before, strict=True)
            if seen is not None and seen[1] and seen[4] in gone
        ]

    @property
    def illegal(self) -> list[Cause]:
        """Causes for which the illegal-configuration flag is up; empty: it is down.

        A cause raised by several processes is listed once.

        Raises:
            SvarError: The causes change faster than they can be read.
        """
        found = self._open().causes()
        if found is None:
            raise SvarError(
                "the causes of the flag change faster than they can be read",
                where=self.name,
                remedy="find the module that raises and clears continuously",
            )
        first = {fields[:3]: Cause(*fields) for fields in reversed(found)}
        return [first[key] for key in dict.fromkeys(fields[:3] for fields in found)]

    @property
    def unlisted(self) -> int:
        """Number of causes refused for lack of room since the table was made."""
        return self._open().unlisted

    def raise_illegal(self, cause: str, raiser: str, machine: str = "") -> None:
        """Raise the flag; raising the same cause again changes nothing.

        The entry belongs to this process: only it may clear the entry, or any process
        after its death. Raising never waits.

        Raises:
            SvarFullError: There is no room; the refusal is counted. The flag is up, but
                not by this cause: raise it again when others have been cleared.
        """
        words = (
            cause.encode(),
            raiser.encode(),
            machine.encode() or table_files.machine(),
        )
        if self._open().raise_illegal(*words) == FULL:
            raise SvarFullError(
                f"there are too many causes; this one was not added: {cause}",
                where=self.name,
                expected=f"at most {CAUSES_EACH} of a process and {CAUSES} in all",
                remedy="the flag is up anyway; clear other causes and raise it again",
            )

    def clear_illegal(self, raiser: str, cause: str = "", machine: str = "") -> int:
        """Clear what `raiser` raised on this machine; return the number of entries.

        Raises:
            SvarOwnerError: Another, live process has raised it.
        """
        words = (
            cause.encode(),
            raiser.encode(),
            machine.encode() or table_files.machine(),
        )
        if (code := self._open().clear_illegal(*words)) == ALIVE:
            raise SvarOwnerError(
                f"the causes of {raiser} are not cleared, because its process is alive",
                where=self.name,
                expected="the process that raised it, or its end",
                remedy=f"let {raiser} clear it, or end it first",
            )
        return code

    def must_be_whole(self) -> None:
        """Refuse a table whose file was truncated (see `survive_cuts`) or overwritten.

        Raises:
            SvarDamagedError: Mapped bytes are missing, or the directory is not valid.
        """
        table_files.must_be_whole(self.path, self._open())

    @property
    def arena(self) -> Arena:
        """The mapped file; for native code."""
        return self._open()

    def close(self) -> None:
        """Detach from the table (svarDetach); its local tables remain usable."""
        self._arena = None

    def destroy(self) -> None:
        """Remove the file and detach; other users continue to work.

        A file that has replaced this one since is left alone.
        """
        shm.remove_same(self.path, self._open().fileno)
        self.close()

    def _open(self) -> Arena:
        if self._arena is None:
            raise table_files.closed(self.name)
        return self._arena

    def _number(self, which: str | int) -> int:
        if isinstance(which, str):
            return self.index(which)
        if 0 <= which < len(self._variables):
            return which
        raise UnknownVariableError(
            "the table has no variable of that index",
            where=self.name,
            expected=f"0 to {len(self._variables) - 1}",
            got=f"{which}",
            remedy="index(NAME) returns the index of a variable",
        )

    def _read_raw(
        self, number: int
    ) -> tuple[array[Any], tuple[int, bool, int, int, int, int, str]]:
        variable = self._variables[number]
        room = _room(variable)
        seen = self._open().look(number, room)
        if seen is None:
            self.must_be_whole()
            raise SvarError(
                f"{variable.name} could not be read completely",
                where=self.name,
                remedy="its writer commits faster than this reader can copy; try again",
            )
        return lay.elements(variable, room), seen

    def _check_lock(self, code: int) -> None:
        if code in {STUCK, GONE}:
            raise table_files.locked_out(self.name, code)


def _room(variable: Variable) -> bytearray:
    return bytearray(lay.var_bytes(variable))
