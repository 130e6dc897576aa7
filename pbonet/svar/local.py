"""A task's local state variable table (Stewart 1994, sections 3.6 and 5.5)."""

from __future__ import annotations

import contextlib
import math
import mmap
from array import array
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pbonet import shm
from pbonet.errors import (
    SvarError,
    SvarFullError,
    SvarOwnerError,
    UnknownVariableError,
    did_you_mean,
)

from . import guards, layout, table_files
from ._svar import Arena, LocalTable as NativeTable, now_ns as clock_ns, process_start
from .freshness import plan_limits
from .result_codes import (
    CONSTS,
    FULL,
    GONE,
    IN,
    ON,
    OUT_CONSTS,
    RIVAL,
    STUCK,
    VARS,
    Flags,
)
from .table_records import Counts

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Mapping

    from numpy.typing import NDArray

    from pbonet.config import Variable

    from .freshness import Freshness


def _never() -> bool:
    return False


class LocalTable(shm.Closeable, NativeTable):
    """Private copies of a task's variables, and the transfers to and from the table.

    Made by `Table.local`. Variables are given by name, or by their index in the table.
    `copy_in`, `copy_in_on`, `copy_in_consts` and `commit` are native and return
    `Flags`; 0 is success. An object may be used by one thread only.
    """

    _task: str
    _table: str
    _variables: tuple[Variable, ...]
    _memory: memoryview
    _arrays: dict[int, NDArray[Any]]
    _places: dict[str | int, tuple[int, int]]
    _groups: tuple[layout.Group, layout.Group]
    _written: dict[str | int, tuple[int, int]]
    _plans: dict[int, list[int]]
    _limits: dict[int, float]
    _closed: bool
    _owner: int

    @classmethod
    def make(
        cls,
        arena: Arena,
        variables: tuple[Variable, ...],
        *,
        table: str,
        task: str,
        pid: int,
        ports: list[list[int]],
        keep: bool,
    ) -> LocalTable:
        """Lay out the local table and take its registers; called by `Table.local`."""
        inconst, outconst, invar, outvar = ports
        both = set(outconst) & set(outvar)
        if both:
            raise SvarOwnerError(
                f"{variables[both.pop()].name} is an out-const and an out-var",
                where=f"{table}/{task}",
                remedy="name it in OUTCONST or in OUTVAR",
            )
        if process_start(pid) == 0:
            raise SvarOwnerError(
                f"there is no process {pid}",
                where=f"{table}/{task}",
                expected="the process of the task",
                remedy="give the id of a running process, such as os.getpid()",
            )
        groups = (
            layout.group_of(variables, outvar),
            layout.group_of(variables, outconst),
        )
        places, size = _lay_out(variables, groups, {*inconst, *invar})
        data = _aligned(size)
        largest = max(len(inconst), len({*invar, *outvar}), 1)
        self = cls(arena, data, _aligned(size) if keep else None, largest)
        self._task, self._table, self._variables = task, table, variables
        self._groups = groups
        self._written = {
            key: (which, place)
            for which, group in enumerate(groups)
            for place, index in enumerate(group.indices)
            for key in (variables[index].name, index)
        }
        self._memory, self._arrays, self._limits = data, {}, {}
        self._places = {
            key: (index, place)
            for index, place in places.items()
            for key in (variables[index].name, index)
        }
        for which, wanted in ((CONSTS, inconst), (IN, invar), (ON, {*invar, *outvar})):
            chosen = sorted(wanted)
            at = array("Q", [places[i] for i in chosen])
            self.set_plan(which, array("I", chosen), at)
        self._plans = {IN: sorted(invar), ON: sorted({*invar, *outvar})}
        self._closed = False
        self.given_up = _never
        self._take_registers(pid, places)
        return self

    def keep_fresh(
        self, freshness: Mapping[int, Freshness], settle: float | None = None
    ) -> None:
        """Judge the ages of the in-vars, and pass them on to the out-vars.

        Args:
            freshness: How, by the index of each in-var.
            settle: Seconds that inputs must have been fresh before the task goes on;
                None: until each one with a limit was renewed twice.
        """
        written = set(self._groups[VARS].indices)
        for which, chosen in self._plans.items():
            limits = plan_limits(self._variables, chosen, freshness, written)
            self._limits |= {
                index: limit_ns * 1e-9
                for index, (limit_ns, _, _) in zip(chosen, limits, strict=True)
            }
            self.set_freshness(which, limits, -1.0 if settle is None else settle)

    def keep_safe(self, values: Mapping[str, object]) -> bytes:
        """Set what the out-vars become when a cycle fails in time.

        Args:
            values: Of each out-var, as its elements or one number for all of them.

        Returns:
            The values as they are committed.

        Raises:
            SvarError: A commit of them would be refused: one is not finite, outside
                its limits, or does not fit the variable's type.
        """
        import numpy as np

        group = self._groups[VARS]
        image = bytearray(group.bytes)
        for index, at in zip(group.indices, group.at, strict=True):
            variable = self._variables[index]
            given = np.broadcast_to(np.array(values[variable.name]), variable.nelem)
            where = f"safe values of {self._table}/{self._task}"
            data = guards.typed(where, variable, given.tolist()).tobytes()
            image[at : at + len(data)] = data
        self.set_safe(image)
        return bytes(image)

    def was_made_safe(self) -> None:
        """Nothing is left to do: the values were committed when the cycle failed."""

    def _take_registers(self, pid: int, places: dict[int, int]) -> None:
        self._owner = 0
        for which, group in enumerate(self._groups):
            first = places[group.indices[0]] if group.indices else 0
            self.set_group(
                which,
                array("I", group.indices),
                array("Q", group.at),
                first,
                group.bytes,
                guards.checks_of(self._variables, group),
            )
            if not group.indices:
                continue
            code = self.enter(which, self._owner, pid, self._task.encode())
            if code < 0:
                with contextlib.suppress(SvarError):
                    self.close()
                self._check(code)
            self._owner = self._owner or self.register_uid(which)

    @property
    def task(self) -> str:
        """The task's name."""
        return self._task

    @property
    def owner(self) -> int:
        """Identity of the task for `Table.reap`; 0 if it writes nothing."""
        return self._owner

    @property
    def claimed(self) -> bool:
        """Whether the task owns its out-vars."""
        return self.owns(VARS)

    @property
    def consumed(self) -> list[tuple[int, int]]:
        """(register uid, sequence) of every group in the last copy."""
        return self.pairs

    @property
    def counters(self) -> Counts:
        """Totals since the local table was made."""
        return Counts(**self.counts)

    @property
    def blamed(self) -> guards.Blamed:
        """Variable and element of the last refused commit or stale copy."""
        if self.action and self.flags & Flags.COPY_STALE:
            return self._blamed_age(self.fault[0])
        one, element = guards.blamed(self._variables, self._groups, *self.fault)
        if one.name not in self._places:  # no value was refused yet
            return guards.Blamed()
        return guards.blame(one, element, self.array(one.name))

    def _blamed_age(self, index: int) -> guards.Blamed:
        """Return the input that was too old in the last copy, its age and its limit."""
        age, limit = self.age(index), self._limits[index]
        return guards.Blamed(
            self._variables[index].name,
            got="never written" if age == math.inf else f"{age:.3g} s",
            expected=f"at most {limit:g} s",
        )

    def names(self) -> list[str]:
        """Return the variables of the local table."""
        return [name for name in self._places if isinstance(name, str)]

    def array(self, which: str | int) -> NDArray[Any]:
        """Return the private copy of a variable: one-dimensional, writable, for life.

        It is the same array by name (svarTranslate) and by index.

        Raises:
            UnknownVariableError: The task has no such variable.
        """
        index, _ = self._place_of(which)
        made = self._arrays.get(index)
        if made is None:
            import numpy as np  # not in an agent, which uses `memory`

            made = np.frombuffer(self.memory(which), self._variables[index].dtype)
            self._arrays[index] = made
        return made

    def memory(self, which: str | int) -> memoryview:
        """Return the bytes of the private copy of a variable, writable.

        Raises:
            UnknownVariableError: The task has no such variable.
        """
        index, at = self._place_of(which)
        variable = self._variables[index]
        return self._memory[at : at + variable.itemsize * variable.nelem]

    def _place_of(self, which: str | int) -> tuple[int, int]:
        """Return index and place of a variable.

        Raises:
            UnknownVariableError: The task has no such variable.
        """
        try:
            return self._places[which]
        except KeyError:
            raise UnknownVariableError(
                f"{self._task} has no {_called(which)}",
                where=self._table,
                remedy=did_you_mean(str(which), self.names())
                or "name it in the task's .rmod file",
            ) from None

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Commit the out-consts and own them; returns flags, if any without committing.

        A constant to which its owner gives the same value stays with that owner.

        Raises:
            SvarOwnerError: A live task gives one of them another value.
        """
        return self._take(OUT_CONSTS, now_ns, 0)

    def claim(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Commit the out-vars and own them all, as one event; returns flags.

        Nothing is committed or owned if a flag is set.

        Args:
            now_ns: The time; 0: read the clock.
            cycle: The writer's cycle.
            own_ns: The time of the values, if the module gives one.

        Raises:
            SvarOwnerError: A live task owns one of them.
            SvarFullError: Some of them are in the task's register and others were set
                or taken over since; that needs a new register, and none is free.
        """
        if self.given_up():
            self.take_over_from([])
        return self._take(VARS, now_ns, cycle, own_ns)

    def check_claim(self) -> None:
        """Check, before a module is turned on, whether `claim` would be refused.

        Raises:
            SvarOwnerError: A live task owns one of the out-vars.
            SvarFullError: The task needs a new register, and none is free.
        """
        self._must_be_open()
        self._judge(*self.ask(VARS))

    def release(self) -> None:
        """Release the out-vars; their values remain until another task takes over."""
        self._check(self.give(VARS, False))  # noqa: FBT003

    def take_over_from(self, tasks: Iterable[str]) -> None:
        """Set the tasks that hand over: `claim` takes their variables while they live.

        So the variables go from one task to the other as one event, and always have an
        owner. If `given_up` returns True by then, because the hand-over was abandoned,
        they are only taken if they have no owner.

        Args:
            tasks: Their names; empty ends it.
        """
        self.given_up = _never
        self.succeed(VARS, [name.encode() for name in tasks])

    def have_ended(self) -> None:
        """Record that the tasks that hand over have ended and write no more.

        A task that commits after this was turned on again, and `claim` takes nothing
        from it.

        Raises:
            SvarError: The table's lock could not be taken.
        """
        self._check(self.note_ends(VARS))

    @contextmanager
    def replacing(self, tasks: Iterable[str]) -> Generator[None]:
        """Let `copy_out_consts` take constants from live tasks, in the block.

        Args:
            tasks: Their names. They lose their constants even if the values differ.
        """
        self.succeed(OUT_CONSTS, [name.encode() for name in tasks])
        try:
            yield
        finally:
            self.succeed(OUT_CONSTS, [])

    def stale(self, which: str | int) -> bool:
        """Return whether an in-var was older than its MAXAGE at the last copy.

        Raises:
            UnknownVariableError: The task has no such variable.
        """
        try:
            return self.is_stale(self._places[which][0])
        except KeyError:
            self._place_of(which)
            raise

    def age(self, which: str | int) -> float:
        """Return the age of an in-var by the last copy, in seconds; inf: never written.

        Raises:
            UnknownVariableError: The task has no such variable.
        """
        try:
            age_ns = self.age_ns(self._places[which][0])
        except KeyError:
            self._place_of(which)
            raise
        return math.inf if age_ns < 0 else age_ns * 1e-9

    def stamp_of(self, which: str | int) -> int:
        """Return the time of what is computed from an in-var alone; 0: its own time.

        Raises:
            UnknownVariableError: The task has no such variable.
        """
        try:
            return self.stamp_from(self._places[which][0])
        except KeyError:
            self._place_of(which)
            raise

    def read(self, which: str | int) -> int:
        """Copy one variable to the local table (svarRead, svarReadIx).

        Returns flags, as `copy_in` does.
        """
        try:
            return self.read_one(*self._places[which])
        except KeyError:
            self._place_of(which)
            raise

    def write(self, which: str | int, now_ns: int = 0, cycle: int = 0) -> int:
        """Commit one out-var or out-const (svarWrite, svarWriteIx); returns flags.

        Only this variable is checked and sent; the others keep their last values.

        Raises:
            UnknownVariableError: The task does not write it.
        """
        try:
            group, place = self._written[which]
        except KeyError:
            raise UnknownVariableError(
                f"{self._task} does not write {_called(which)}",
                where=self._table,
                remedy="name it in OUTVAR of the task's .rmod file",
            ) from None
        self._must_be_open()
        return self.write_one(group, place, now_ns or clock_ns(), cycle)

    def close(self) -> None:
        """Release all variables; values remain, the registers may be reused."""
        self._closed = True
        codes = [self.give(which, True) for which in (VARS, OUT_CONSTS)]  # noqa: FBT003
        self._check(min(codes))

    def _must_be_open(self) -> None:
        """Refuse to write after the registers may have been reused.

        Raises:
            SvarError: The local table was closed.
        """
        if self._closed:
            raise SvarError(
                "the local table was closed",
                where=f"{self._table}/{self._task}",
                expected="to write before close()",
                remedy="make a new one with Table.local",
            )

    def _take(self, which: int, now_ns: int, cycle: int, own_ns: int = 0) -> int:
        self._must_be_open()
        code, rival = self.take(which, now_ns or clock_ns(), cycle, own_ns)
        self._judge(code, rival, constants=which == OUT_CONSTS)
        return self.flags

    def _judge(self, code: int, rival: int, *, constants: bool = False) -> None:
        if code == RIVAL:
            variable = self._variables[rival]
            room = bytearray(layout.var_bytes(variable))
            seen = self.arena.look(rival, room)
            owner = (seen[-1] if seen and seen[1] else "") or "another task"
            if constants:
                raise SvarOwnerError(
                    f"{self._task} gives the constant {variable.name} another value "
                    "than its owner",
                    where=self._table,
                    expected="one value of a constant",
                    got=f"owner {owner}",
                    remedy=f"kill {owner} first, or give {self._task} an alias for "
                    f"{variable.name}",
                )
            raise SvarOwnerError(
                f"{self._task} cannot write {variable.name}: another task does",
                where=self._table,
                expected="one task that writes a variable",
                got=f"owner {owner}",
                remedy=f"turn {owner} off first, or give {self._task} an alias for "
                f"{variable.name} and join both",
            )
        self._check(code)

    def _check(self, code: int) -> None:
        if code in {STUCK, GONE}:
            raise table_files.locked_out(self._table, code)
        if code == FULL:
            raise SvarFullError(
                f"no register is free for {self._task}",
                where=self._table,
                expected="room for four times each group of the task, and for a fresh "
                "one when it is turned on again",
                remedy="kill tasks that are not needed, or make the table with more "
                "`spare`",
            )


def _lay_out(
    variables: tuple[Variable, ...],
    groups: tuple[layout.Group, layout.Group],
    inputs: Iterable[int],
) -> tuple[dict[int, int], int]:
    """Return the place of every variable in the local table, and its size.

    Groups come first, each laid out as in the table; then the variables only read.
    """
    places: dict[int, int] = {}
    size = 0
    for group in groups:
        for index, at in zip(group.indices, group.at, strict=True):
            places[index] = size + at
        size = layout.padded(size + group.bytes, layout.LINE)
    for index in sorted(inputs):
        if index not in places:
            places[index] = size
            size += layout.var_bytes(variables[index])
    return places, size


def _called(which: str | int) -> str:
    return (
        f"variable {which}" if isinstance(which, str) else f"variable of index {which}"
    )


def _aligned(size: int) -> memoryview:
    """Return zeroed bytes of this process that begin at a page's boundary."""
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE
    return memoryview(mmap.mmap(-1, layout.padded(max(size, 1), layout.LINE), flags))
