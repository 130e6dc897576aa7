"""A state variable table in plain memory, for one thread and virtual time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pbonet.config import Limit
from pbonet.errors import SvarOwnerError
from pbonet.svar import Blamed, Flags, blame, group_of, limits_of, values_of
from pbonet.xm.net import VarValue, plain

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from pbonet.config import Rmod, Variable

    Values = NDArray[Any]


class MemoryTable:
    """Every variable at its INIT value, and the illegal flag's causes.

    Nobody owns a variable here: a job that gives it two writers is refused before it
    is simulated.

    Args:
        variables: What the ``.svar`` file defines.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        self.variables = tuple(variables)
        self.numbers = {v.name: index for index, v in enumerate(variables)}
        self.values = {v.name: values_of(v, v.init, where="INIT") for v in variables}
        self.causes: set[str] = set()
        self._said: set[tuple[str, str]] = set()
        self.written: dict[str, int] = {}
        """When each variable was written last, in virtual nanoseconds."""
        self._givers: dict[str, dict[str, Values]] = {}
        self.commits: dict[str, tuple[int, int]] = {}
        """Register and number of the commit that each variable stands from."""

    def give(
        self, task: str, constants: Mapping[str, Values], replaces: Collection[str]
    ) -> None:
        """Take note of the constants of a task, in the place of those that leave.

        Raises:
            SvarOwnerError: Another task gives one of them another value.
        """
        for name, value in constants.items():
            for owner, given in self._givers.get(name, {}).items():
                if owner in {task, *replaces}:
                    continue
                if not np.array_equal(given, value):
                    raise SvarOwnerError(
                        f"{task} gives the constant {name} another value than its "
                        "owner",
                        expected="one value of a constant",
                        got=f"owner {owner}",
                        remedy=f"kill {owner} first, or give {task} an alias for "
                        f"{name}",
                    )
        for name, value in constants.items():
            givers = self._givers.setdefault(name, {})
            for owner in replaces:
                givers.pop(owner, None)
            givers[task] = value.copy()

    def forget(self, task: str) -> None:
        """Let go of the constants of a task that is no more."""
        for givers in self._givers.values():
            givers.pop(task, None)

    @property
    def illegal(self) -> set[str]:
        """Every cause that stands, also those that modules gave."""
        return self.causes | {f"{cause} ({raiser})" for raiser, cause in self._said}

    def said(self, raiser: str, cause: str, *, up: bool) -> None:
        """Take or withdraw a module's cause; an empty one withdraws all of its.

        Args:
            raiser: ``RTPU/TASK``.
            cause: Why.
            up: Whether it is taken.
        """
        if up:
            self._said.add((raiser, cause))
        else:
            self._said -= {
                one for one in self._said if one[0] == raiser and cause in {"", one[1]}
            }

    def index(self, name: str) -> int:
        """Return the number of a variable."""
        return self.numbers[name]

    def stale(self, name: str, now_ns: int) -> bool:
        """Tell whether a variable is older than its MAXAGE, or was never written."""
        maxage = self.variables[self.numbers[name]].maxage
        if maxage is None:
            return False
        written = self.written.get(name)
        return written is None or now_ns - written > maxage * 1e9

    def look(self, name: str, now_ns: int) -> VarValue:
        """Return a variable as an agent shows it, without its writer."""
        number = self.numbers[name]
        value, written = self.values[name], self.written.get(name)
        return VarValue(
            name=name,
            index=number,
            values=plain(value),
            units=self.variables[number].units,
            desc=self.variables[number].desc,
            age=None if written is None else (now_ns - written) * 1e-9,
            stale=self.stale(name, now_ns),
        )


class _Pair(NamedTuple):
    """A variable's copy of a task, and its values in the table."""

    variable: Variable
    local: Values
    shared: Values


class _Limit(NamedTuple):
    """A variable whose range is enforced."""

    pair: _Pair
    low: Values
    high: Values


class _Outputs:
    """What goes out together, and what it is judged by."""

    def __init__(self, pairs: list[_Pair]) -> None:
        self.pairs = pairs
        self.finite = [
            pair
            for pair in pairs
            if pair.variable.finite and pair.local.dtype.kind == "f"
        ]
        self.limits = [
            _Limit(pair, *limits_of(pair.variable))
            for pair in pairs
            if pair.variable.limit is not Limit.NONE and pair.local.dtype.kind in "iuf"
        ]


class MemoryCopies:
    """The local table of a task, and its copies; see `port_transfer.Copies`.

    Args:
        table: The global one; it has the variables behind all ports.
        rmod: Names the task's ports.
        task: Its name.
    """

    def __init__(self, table: MemoryTable, rmod: Rmod, task: str) -> None:
        self._task = task
        self.blamed = Blamed()
        self.committed = False
        """Whether a commit has succeeded since this was set to False."""
        self.hold = False
        """Keep what a commit writes to `publish`, when its cycle takes virtual time."""
        self.replaces: Collection[str] = ()
        """Tasks that leave: their constants are taken over, whatever the values."""
        self.uid = 0
        """The task's register; 0: nobody asks whose a commit is."""
        self.out_number = 0
        """The number of its last commit."""
        self.out_vars = _named(rmod, rmod.outvar)
        self._held: list[tuple[Values, Values]] = []
        self._held_ns = 0
        self._table = table
        self._local: dict[str, Values] = {}
        self._in_consts = self._pairs(_named(rmod, rmod.inconst))
        self._out_consts = _Outputs(self._pairs(_named(rmod, rmod.outconst)))
        self._in_vars = self._pairs(_named(rmod, rmod.invar))
        self._out_vars = _Outputs(self._pairs(self.out_vars))
        numbers = [table.numbers[name] for name in self.out_vars]
        group = group_of(table.variables, numbers)
        self._group = np.zeros(group.bytes, np.uint8)
        self._parts: list[tuple[Values, Values]] = []
        for index, at in zip(group.indices, group.at, strict=True):
            raw = self._local[table.variables[index].name].view(np.uint8)
            self._parts.append((self._group[at : at + raw.size], raw))

    def array(self, name: str) -> Values:
        """Return the local copy of a variable, at an address that stays."""
        return self._local[name]

    @property
    def out_uid(self) -> int:
        """The register of its last commit."""
        return self.uid

    def consumed(self) -> list[tuple[int, int]]:
        """Return which commits the in-vars stand from; register 0 is nobody's."""
        commits = self._table.commits
        found = {commits.get(one.variable.name, (0, 1)) for one in self._in_vars}
        return sorted(found)

    def group(self) -> bytes:
        """Return the out-vars as a group, laid out as a register of the real table."""
        for part, raw in self._parts:
            part[:] = raw
        return self._group.tobytes()

    def copy_in_consts(self) -> int:
        """Copy the in-consts in."""
        return _in(self._in_consts)

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Copy the out-consts out.

        Raises:
            SvarOwnerError: Another task gives one of them another value.
        """
        pairs = self._out_consts.pairs
        given = {one.variable.name: one.local for one in pairs}
        self._table.give(self._task, given, self.replaces)
        return self._out(self._out_consts, now_ns)

    def copy_in(self) -> int:
        """Copy the in-vars in."""
        return _in(self._in_vars)

    def copy_in_on(self) -> int:
        """Copy the in-vars and the out-vars in."""
        return _in(self._in_vars) or _in(self._out_vars.pairs)

    def check_claim(self) -> None:
        """Do nothing: there is no second writer."""

    def claim(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out."""
        del cycle
        flags = self._out(self._out_vars, now_ns)
        self._number(flags)
        return flags

    def commit(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out."""
        del cycle
        if self.hold:
            flags = self._judge(self._out_vars)
            if not flags:
                pairs = self._out_vars.pairs
                self._held = [(shared, local.copy()) for _, local, shared in pairs]
                self._held_ns = now_ns
        else:
            flags = self._out(self._out_vars, now_ns)
            self._number(flags)
        self.committed = not flags
        return flags

    def _number(self, flags: int) -> None:
        """Take note of a commit, where somebody asks whose it is."""
        if self.uid and not flags:
            self.out_number += 1
            key = self.uid, self.out_number
            self._table.commits.update(dict.fromkeys(self.out_vars, key))

    def publish(self) -> None:
        """Copy out what was held; nothing when nothing is."""
        for shared, values in self._held:
            shared[...] = values
        if self._held:
            self._table.written.update(dict.fromkeys(self.out_vars, self._held_ns))
        self._held = []

    def cede(self) -> None:
        """Do nothing: the values stand."""

    def release(self) -> None:
        """Do nothing: the values stand."""

    def _pairs(self, names: Iterable[str]) -> list[_Pair]:
        pairs: list[_Pair] = []
        for name in names:
            shared = self._table.values[name]
            local = self._local.setdefault(name, shared.copy())
            variable = self._table.variables[self._table.numbers[name]]
            pairs.append(_Pair(variable, local, shared))
        return pairs

    def _out(self, outputs: _Outputs, now_ns: int) -> int:
        if flags := self._judge(outputs):
            return flags
        for variable, local, shared in outputs.pairs:
            shared[...] = local
            self._table.written[variable.name] = now_ns
        return 0

    def _judge(self, outputs: _Outputs) -> int:
        """Return the flag of a value that is refused; clip those that may be."""
        for variable, local, _ in outputs.finite:
            finite = np.isfinite(local)
            if not finite.all():
                self.blamed = blame(variable, int(np.argmin(finite)), local)
                return int(Flags.COMMIT_NONFINITE)
        for (variable, local, _), low, high in outputs.limits:
            if variable.limit is Limit.CLIP:
                np.clip(local, low, high, out=local)
            outside = (local < low) | (local > high)  # NaN is not: FINITE judges it
            if outside.any():
                self.blamed = blame(variable, int(np.argmax(outside)), local)
                return int(Flags.COMMIT_LIMIT)
        return 0


def _in(pairs: list[_Pair]) -> int:
    for _, local, shared in pairs:
        local[...] = shared
    return 0


def _named(rmod: Rmod, ports: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(map(rmod.svar_name, ports))
