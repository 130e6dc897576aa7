"""A state variable table in plain memory, for one thread and virtual time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.config.model import Limit
from pbonet.errors import SvarOwnerError, UnknownVariableError, did_you_mean
from pbonet.svar import Flags
from pbonet.svar.guards import limits_of
from pbonet.svar.layout import group_of, values_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from pbonet.config.model import Rmod, Variable


class MemoryTable:
    """Every variable at its INIT value, who owns it, and the illegal flag's causes.

    Args:
        variables: What the ``.svar`` file defines.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        self.variables = tuple(variables)
        self.values = {v.name: values_of(v, v.init, where="INIT") for v in variables}
        self.owners: dict[str, str] = {}
        self.causes: set[str] = set()

    def local(self, task: str, rmod: Rmod) -> MemoryCopies:
        """Return what carries the ports of a task.

        Raises:
            UnknownVariableError: An RMOD's port stands for no variable of the table.
        """
        return MemoryCopies(self, task, rmod)

    def number(self, name: str) -> int:
        """Return the index of a variable.

        Raises:
            UnknownVariableError: There is none of that name.
        """
        for index, variable in enumerate(self.variables):
            if variable.name == name:
                return index
        raise UnknownVariableError(
            f"the table has no variable {name}",
            remedy=did_you_mean(name, self.values)
            or "add it to the .svar file, or correct the alias",
        )


class MemoryCopies:
    """The local table of a task, and its copies; see `pbonet.node.copies.Copies`.

    Args:
        table: The global one.
        task: The task's name.
        rmod: Names its ports.
    """

    def __init__(self, table: MemoryTable, task: str, rmod: Rmod) -> None:
        self.task = task
        self.blamed = ("", 0)
        self.committed = False
        """Whether a commit has succeeded since this was set to False."""
        self._table = table
        self._in_consts = _named(rmod, rmod.inconst)
        self._out_consts = _named(rmod, rmod.outconst)
        self._in_vars = _named(rmod, rmod.invar)
        self.out_vars = _named(rmod, rmod.outvar)
        ports = (self._in_consts, self._out_consts, self._in_vars, self.out_vars)
        numbers = {name: table.number(name) for names in ports for name in names}
        self._local = {name: table.values[name].copy() for name in numbers}
        variables = table.variables
        self._group = group_of(variables, (numbers[name] for name in self.out_vars))
        self._checked = [variables[i] for i in self._group.indices]
        self._checked += [variables[numbers[name]] for name in self._out_consts]
        self._limits = {
            v.name: limits_of(v)
            for v in self._checked
            if v.limit is not Limit.NONE and v.min and v.max
        }

    def array(self, name: str) -> NDArray[Any]:
        """Return the local copy of a variable, at an address that stays."""
        return self._local[name]

    def group(self) -> bytes:
        """Return the out-vars as a group, laid out as a register of the real table."""
        room = np.zeros(self._group.bytes, np.uint8)
        variables = self._table.variables
        for index, at in zip(self._group.indices, self._group.at, strict=True):
            raw = self._local[variables[index].name].view(np.uint8)
            room[at : at + raw.size] = raw
        return room.tobytes()

    def copy_in_consts(self) -> int:
        """Copy the in-consts in."""
        return self._in(self._in_consts)

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Copy the out-consts out."""
        del now_ns
        return self._out(self._out_consts)

    def copy_in(self) -> int:
        """Copy the in-vars in."""
        return self._in(self._in_vars)

    def copy_in_on(self) -> int:
        """Copy the in-vars and the out-vars in."""
        return self._in((*self._in_vars, *self.out_vars))

    def check_claim(self) -> None:
        """Raise when another task owns an out-var.

        Raises:
            SvarOwnerError: One does.
        """
        for name in self.out_vars:
            owner = self._table.owners.get(name, self.task)
            if owner != self.task:
                raise SvarOwnerError(
                    f"{name} has a writer",
                    where=self.task,
                    got=f"owner {owner}",
                    remedy=f"turn {owner} off first",
                )

    def claim(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out and own them."""
        flags = self._out(self.out_vars)
        if not flags:
            del now_ns, cycle
            self._table.owners.update(dict.fromkeys(self.out_vars, self.task))
        return flags

    def commit(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out."""
        del now_ns, cycle
        flags = self._out(self.out_vars)
        self.committed = not flags
        return flags

    def release(self) -> None:
        """Own nothing any more; the values stand."""
        for name in self.out_vars:
            if self._table.owners.get(name) == self.task:
                del self._table.owners[name]

    def _in(self, names: Iterable[str]) -> int:
        for name in names:
            self._local[name][...] = self._table.values[name]
        return 0

    def _out(self, names: Iterable[str]) -> int:
        wanted = tuple(names)
        for variable in self._checked:
            if variable.name in wanted and (flag := self._judge(variable)):
                return flag
        for name in wanted:
            self._table.values[name][...] = self._local[name]
        return 0

    def _judge(self, variable: Variable) -> int:
        """Return the flag of a value that is refused; clip one that may be clipped."""
        values = self._local[variable.name]
        if variable.finite and values.dtype.kind == "f":
            finite = np.isfinite(values)
            if not finite.all():
                self.blamed = (variable.name, int(np.argmin(finite)))
                return int(Flags.COMMIT_NONFINITE)
        if variable.name in self._limits:
            low, high = self._limits[variable.name]
            if variable.limit is Limit.CLIP:
                np.clip(values, low, high, out=values)
            inside = (values >= low) & (values <= high)
            if not inside.all():
                self.blamed = (variable.name, int(np.argmin(inside)))
                return int(Flags.COMMIT_LIMIT)
        return 0


def _named(rmod: Rmod, ports: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(map(rmod.svar_name, ports))
