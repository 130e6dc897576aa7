"""Twin of the native half of a local table (local.h, cut.h, guard.h)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.svar import CONSTS, IN, ON, OUT_CONSTS, RIVAL, VARS, Flags

from .arena import LINE, Arena, kept
from .process import now_ns

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from pbonet.svar import Check

TRIES, TRIES_WHOLE = 16, 256
_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")
_FINITE, _CLIP = 0, 1
_CONSISTENT, _WHOLE, _LOST = range(3)


def is_whole(head: int, again: int) -> bool:
    """Return whether a copy from under `head` is whole, `again` found after it."""
    return (again >> 8) - (head >> 8) <= kept(again)


class Group:
    """What is written together; iterates over (variable, place in the group)."""

    def __init__(self) -> None:
        self.vars: list[int] = []
        self.at: list[int] = []
        self.first = self.bytes = self.reg = self.uid = 0
        self.checks: list[Check] = []
        self.live = False
        self.predecessors: set[str] = set()
        self.ends: dict[int, tuple[int, int] | None] | None = None
        """What the owner of each variable had committed when those had ended."""
        self.data = memoryview(b"")

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return zip(self.vars, self.at, strict=True)

    def value(self, at: int, size: int) -> bytes:
        """Return bytes of the group out of the local table."""
        return bytes(self.data[self.first + at : self.first + at + size])


class LocalTable:
    """A task's private copies, and the transfers to and from the table."""

    def __init__(
        self,
        arena: Arena,
        data: NDArray[Any],
        staging: NDArray[Any] | None,
        *_largest: int,
    ) -> None:
        self.arena = arena
        self.data = np.frombuffer(data, np.uint8)
        self.keep = staging is not None
        self.plans: list[list[tuple[int, int]]] = [[], [], []]
        self.groups = [Group(), Group()]
        for group in self.groups:
            group.data = self.data.data
        self.flags = self.cycles = self.out_uid = 0
        self.pairs: list[tuple[int, int]] = []
        self.fault = 0, 0
        self.times: dict[int, int] = {}
        names = "copies retries torn lost stale commits refused clipped"
        self.counts = dict.fromkeys(names.split(), 0)

    def set_plan(self, which: int, vars: NDArray[Any], to: NDArray[Any]) -> None:  # noqa: A002
        """Say which variables a copy brings, and to which places."""
        self.plans[which] = list(zip(vars.tolist(), to.tolist(), strict=True))

    def set_group(  # noqa: PLR0917 - as the native one
        self,
        which: int,
        vars: NDArray[Any],  # noqa: A002
        at: NDArray[Any],
        first: int,
        size: int,
        checks: list[Any],
    ) -> None:
        """Say what is written together, and what is looked at before it goes out."""
        group = self.groups[which]
        group.vars, group.at = vars.tolist(), at.tolist()
        group.first, group.bytes, group.checks = first, size, checks

    def set_safe(self, values: NDArray[Any]) -> None:
        """Take safe values; here no cycle fails in time, so nothing is done with them.

        Raises:
            ValueError: They are of another size than the out-vars.
        """
        if len(values) != self.groups[VARS].bytes:
            raise ValueError("the values are of another size")

    # -- ownership ---------------------------------------------------------------------

    def enter(self, which: int, owner: int, pid: int, task: bytes) -> int:
        """Take a register for a group."""
        code = self.arena.enter(self.groups[which].bytes, (owner, pid, task))
        if code > 0:
            self.groups[which].reg = code
            self.groups[which].uid = self.arena.uid(code)
        return code

    def register_uid(self, which: int) -> int:
        """Return the uid of a group's register."""
        return self.groups[which].uid

    def ask(self, which: int) -> tuple[int, int]:
        """Return what a claim would be answered."""
        group, constants = self.groups[which], which == OUT_CONSTS
        refused = self.arena.refused(group, constants=constants)
        if refused is not None:
            return RIVAL, refused
        if not self.arena.divided(group, constants=constants):
            return 0, 0
        return min(self.arena.find(group.bytes)[0], 0), 0

    action = 0  # inputs have no freshness here

    def take(self, which: int, now: int, cycle: int, own: int = 0) -> tuple[int, int]:
        """Judge, commit and claim a group."""
        assert not own
        group = self.groups[which]
        self.flags = self._guard(group)
        if self.flags or not group.vars:
            return 0, 0
        answer = self.arena.claim(group, (now, cycle), constants=which == OUT_CONSTS)
        group.live = group.live or answer[0] == 0
        group.uid = self.arena.uid(group.reg)
        if which == VARS:
            self.out_uid = self.register_uid(VARS)
        return answer

    def succeed(self, which: int, names: list[bytes]) -> None:
        """Let claims of a group take its variables from these tasks."""
        self.groups[which].predecessors = {name[:63].decode() for name in names}
        self.groups[which].ends = None

    def note_ends(self, which: int) -> int:
        """Let only those hand over that commit nothing from here on."""
        arena, group = self.arena, self.groups[which]
        entries = {v: arena.entry(v) for v in group.vars}
        group.ends = {
            v: arena.last_of(reg) if live else None
            for v, (reg, live, _) in entries.items()
        }
        return 0

    def cede(self) -> None:
        """Write no more, and leave the variables to the successor's claim."""
        group = self.groups[VARS]
        if group.live:
            self.arena.cede(group.reg, group.uid)
        group.live = False

    def give(self, which: int, leave: bool) -> int:
        """Give a group's variables up."""
        group = self.groups[which]
        group.live = False
        if not group.reg:
            return 0
        return self.arena.let_go(group.reg, group.uid, leave=leave, dead=False)

    def owns(self, which: int) -> bool:
        """Return whether this process claimed the group."""
        return self.groups[which].live

    # -- copies in ---------------------------------------------------------------------

    def copy_in(self) -> int:
        """Bring the in-vars."""
        return self._copy(IN)

    def copy_in_on(self) -> int:
        """Bring in-vars and out-vars."""
        return self._copy(ON)

    def copy_in_consts(self) -> int:
        """Bring the in-consts."""
        return self._copy(CONSTS)

    def _cut(
        self, plan: list[tuple[int, int]]
    ) -> tuple[int, dict[int, int], list[bytes]]:
        """Read a plan; returns how it went, sequence by register, and the values."""
        arena = self.arena
        heads: dict[int, int] = {}
        values: list[bytes] = []
        for attempt in range(TRIES_WHOLE):
            generation = arena.dir_head
            entries = [arena.entry(v, generation) for v, _ in plan]
            heads = {r: arena.reg(r, 0) for r, _, _ in entries}
            values = []
            for (v, _), (r, _, at) in zip(plan, entries, strict=True):
                start = arena.slot(r, heads[r]) + LINE + at
                values.append(bytes(arena.map[start : start + arena.size_of(v)]))
            again = {r: arena.reg(r, 0) for r in heads}
            torn = [r for r in heads if not is_whole(heads[r], again[r])]
            for r in torn:
                arena.crowd(r, again[r])
            if arena.dir_head == generation:
                *first, last = heads or {0: 0}
                if last not in torn and all(again[r] == heads[r] for r in first):
                    return _CONSISTENT, heads, values
                if attempt >= TRIES - 1 and not torn:
                    return _WHOLE, heads, values
            self.counts["retries"] += 1
        return _LOST, heads, values

    def _copy(self, which: int) -> int:
        plan = self.plans[which]
        self.counts["copies"] += 1
        result, heads, values = self._cut(plan)
        self.flags = 0
        if result != _CONSISTENT:
            self.flags = Flags.COPY_TORN
            self.counts["torn"] += 1
            self.counts["lost"] += result == _LOST
            if self.keep and which == IN:
                self.flags |= Flags.COPY_KEPT
                return self.flags
            if result == _LOST:
                self.flags |= Flags.COPY_LOST
                return self.flags
        for (_, to), value in zip(plan, values, strict=True):
            self.data[to : to + len(value)] = np.frombuffer(value, np.uint8)
        self.pairs = [(self.arena.uid(r), head >> 8) for r, head in heads.items()]
        if which == IN:
            self.times = {v: self._stamp_of(v, heads) for v, _ in plan}
        self.flags |= self._stale(plan, heads)
        return self.flags

    def _stale(self, plan: list[tuple[int, int]], heads: dict[int, int]) -> int:
        for v, _ in plan:
            if flags := self._too_old(v, self._stamp_of(v, heads)):
                return flags
        return 0

    def _stamp_of(self, v: int, heads: dict[int, int]) -> int:
        reg = self.arena.entry(v)[0]
        return int(self.arena.stamp(v, reg, heads[reg])[0])

    def is_stale(self, var: int) -> bool:
        """Tell whether an in-var is older than its MAXAGE, as it was last copied in."""
        maxage, written = self.arena.maxage_of(var), self.times.get(var)
        if not maxage or written is None:
            return False
        return not written or now_ns() - written > maxage

    def _too_old(self, v: int, time_ns: int) -> int:
        maxage = self.arena.maxage_of(v)
        if not maxage or (time_ns and now_ns() - time_ns <= maxage):
            return 0
        self.fault = v, 0
        self.counts["stale"] += 1
        return Flags.COPY_STALE

    # -- copies out --------------------------------------------------------------------

    def _guard(self, group: Group) -> int:
        return self._judge_by(group, group.checks)

    def _judge_by(self, group: Group, checks: list[Check]) -> int:
        for check in checks:
            element = self._first_bad(group, check)
            if element < check.n:
                self.fault = check.var, element
                self.counts["refused"] += 1
                finite = check.rule == _FINITE
                return Flags.COMMIT_NONFINITE if finite else Flags.COMMIT_LIMIT
        return 0

    def _first_bad(self, group: Group, check: Check) -> int:
        dtype = np.dtype(_TYPES[check.type])
        at = group.first + check.at
        x: NDArray[Any] = self.data[at : at + check.n * dtype.itemsize].view(dtype)
        if check.low is None or check.high is None:
            bad = ~np.isfinite(x)
        else:
            low, high = (np.frombuffer(one, dtype) for one in (check.low, check.high))
            bad = (x < low) | (x > high)
            if check.rule == _CLIP:
                self.counts["clipped"] += int(bad.sum())
                x[bad] = np.clip(x, low, high)[bad]
                return check.n
        return int(bad.argmax()) if bad.any() else check.n

    def _send(self, group: Group, value: bytes, stamp: tuple[int, int]) -> None:
        self.arena.commit(group.reg, value, stamp)
        self.counts["commits"] += 1

    def commit(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Send the out-vars."""
        self.cycles = cycle or self.cycles + 1
        group = self.groups[VARS]
        self.flags = 0
        if group.vars:
            self.flags = self._guard(group) if group.live else Flags.COMMIT_NOT_OWNER
        if group.vars and not self.flags:
            stamp = now_ns or _now(), self.cycles
            self._send(group, group.value(0, group.bytes), stamp)
        return self.flags

    def read_one(self, v: int, at: int) -> int:
        """Bring one variable."""
        return self._too_old(v, self.arena.look(v, self.data[at:])[2])

    def write_one(self, which: int, i: int, now: int, cycle: int) -> int:
        """Send one variable; the others keep what was last committed."""
        group, arena = self.groups[which], self.arena
        v, at = group.vars[i], group.at[i]
        size = arena.size_of(v)
        stands = which == VARS or arena.entry(v)[0] == group.reg
        if not group.live or not stands:
            return Flags.COMMIT_NOT_OWNER
        parts = (_narrow(check, at, size) for check in group.checks)
        checks = [part._replace(var=v) for part in parts if part.n > 0]
        if flags := self._judge_by(group, checks):
            return flags
        last = arena.slot(group.reg, arena.reg(group.reg, 0)) + LINE
        value = bytearray(arena.map[last : last + group.bytes])
        value[at : at + size] = group.value(at, size)
        self._send(group, bytes(value), (now, cycle))
        return 0

    @property
    def out_number(self) -> int:
        """Number of the last commit of the out-vars, once they were claimed."""
        return self.arena.reg(self.groups[VARS].reg, 0) >> 8 if self.out_uid else 0

    @property
    def illegal(self) -> bool:
        """Whether the illegal-configuration flag is up."""
        return self.arena.illegal


def _narrow(check: Check, at: int, size: int) -> Check:
    """Return the part of a check that falls upon these bytes of the group."""
    width = int(_TYPES[check.type][1])
    first = max(check.at, at)
    stop = min(check.at + check.n * width, at + size)
    return check._replace(at=first, n=(stop - first) // width)


def _now() -> int:
    return now_ns()
