"""The table's protocol in plain Python: the oracle of the native one.

It works on the same file, byte for byte and step for step as the C headers do. Python
has neither fences nor atomic words, and no lock is taken here: nothing but tests may
use it. `use_plain_table` puts it in the place of the native one.
"""

from __future__ import annotations

import mmap
import os
import platform
import struct
from typing import TYPE_CHECKING, Any

from pbonet.svar import ALIVE, FULL, RIVAL, Verdict

from .flag import FLAG_BYTES, Flag, identity
from .process import lives, process_start, space

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .local import Group

VERSION, STATIC_BYTES = 5, 136
SLOTS, LINE = 4, 64
_EVER = 1 << 64
_NUMBERS = (1 << 56) - 1
FREE, HELD, ENDED, LEFT = range(4)
_MAGIC = b"pbSVAR\r\n"
_STATIC = struct.Struct("<8s4I2Q16s10Q")
_MUTEX = {"x86_64": 40, "aarch64": 48}.get(platform.machine(), 40)
_BEFORE, _AFTER, _UIDS = 64, 72 + _MUTEX, 80 + _MUTEX
_GUARD = 0x70625356415221A5
_ENTRY = struct.Struct("<IIQQ")
_FACTORS = (  # of variable, register and live, place, slots, stride, uid
    0xBF58476D1CE4E5B9,
    0x94D049BB133111EB,
    0xFF51AFD7ED558CCD,
    0xC4CEB9FE1A85EC53,
    0xD6E8FEB86659FD93,
    0xA0761D6478BD642F,
)
_REG_BYTES, _TASK, _TASK_BYTES = 256, 144, 64
_STATE, _SLOTS, _STRIDE, _UID, _CROWD = range(64, 104, 8)
_BYTES, _OWNER, _PID, _START, _SPACE = range(104, 144, 8)


def kept(head: int) -> int:
    """Return how many commits before the newest stay whole (register.h)."""
    return head >> 2 & 3


def advance(head: int, crowd: int) -> int:
    """Return the head of the commit after `head`."""
    move = 3 - (head >> 4 & 3) if kept(head) else 1
    number = (head >> 8) + 1 & _NUMBERS
    keep = min(kept(head) + 1, 2) if number < crowd else 0
    return number << 8 | move << 4 | keep << 2 | (head ^ move) & 3


def _round(size: int, unit: int) -> int:
    return -(-size // unit) * unit


def _stride(size: int) -> int:
    return LINE + _round(size, LINE)


_LIVE_BYTES = _round(_UIDS + 8 + FLAG_BYTES, LINE)
_ABI = _LIVE_BYTES + _MUTEX


class Blueprint:
    """What a table will look like (arena.h)."""

    def __init__(
        self,
        sizes: NDArray[Any],
        maxages: NDArray[Any],
        text: bytes,
        layout: bytes,
        spare: int,
    ) -> None:
        n = len(sizes)
        self.sizes: list[int] = sizes.tolist()
        self.maxages: list[int] = maxages.tolist()
        self.text = text
        stamps = sum(self.sizes)
        keep = stamps + 16 * n
        regs_n = 64 + 2 * n
        variables = _round(STATIC_BYTES, LINE)
        records = variables + 24 * n
        live = _round(records + len(text), LINE)
        regs = live + _LIVE_BYTES
        directory = regs + regs_n * _REG_BYTES
        dir_stride = _stride(_ENTRY.size * n)
        arena = directory + SLOTS * dir_stride
        slots = _stride(keep) + regs_n * _stride(LINE) + spare * _stride(stamps)
        self.size = _round(arena + SLOTS * slots, 4096)
        places = (variables, records, len(text), live, regs, directory, dir_stride)
        counts = (VERSION, _ABI, n, regs_n, self.size, 0, layout)
        self.fixed = _STATIC.pack(_MAGIC, *counts, *places, arena, keep, stamps)


class Arena(Flag):
    """A table's file, mapped whole."""

    def __init__(self, fd: int, size: int, machine: bytes) -> None:
        self.map = memoryview(mmap.mmap(fd, size))
        self.fileno, self.size, self.machine = fd, size, machine

    def __del__(self) -> None:
        if hasattr(self, "fileno"):
            os.close(self.fileno)

    def format(self, plan: Blueprint, values: NDArray[Any]) -> int:
        """Fill fresh zeroed memory."""
        self.map[:STATIC_BYTES] = plan.fixed
        self._read_places()
        at = 0
        for i, (size, maxage) in enumerate(zip(plan.sizes, plan.maxages, strict=True)):
            where = self.vars + 24 * i
            self.map[where : where + 24] = struct.pack("<QQq", size, at, maxage)
            at += size
        self.map[self.records : self.records + len(plan.text)] = plan.text
        self._set_reg(0, _SLOTS, self.arena)
        self._set_reg(0, _STRIDE, _stride(self.keep_bytes))
        self._set_reg(0, _STATE, HELD)
        self.commit(0, bytes(values[: self.keep_stamps]), (0, 0))
        entries = ((0, 0, self.keep_of(v)) for v in range(self.n_vars))
        self._publish(dict(enumerate(entries)))
        self._set(self.live + 8, 1)
        self._set(self.live + _BEFORE, _GUARD)
        self._set(self.live + _AFTER, _GUARD)
        self._set(32, self._checksum())
        return 0

    def _read_places(self) -> None:
        fields = _STATIC.unpack_from(self.map)
        (_, self.version, _, self.n_vars, self.n_regs) = fields[:5]
        (self.layout, self.vars, self.records, self.text_bytes, self.live) = fields[
            7:12
        ]
        self.flag = self.live + _UIDS + 8
        (self.regs, self.dir, self.dir_stride, self.arena) = fields[12:16]
        (self.keep_bytes, self.keep_stamps) = fields[16:]

    def verify(self) -> int:
        """Judge the file (keeper.h)."""
        if self.size < STATIC_BYTES or bytes(self.map[:8]) != _MAGIC:
            return Verdict.NO_TABLE
        fields = _STATIC.unpack_from(self.map)
        self.version = fields[1]
        if fields[1:3] != (VERSION, _ABI):
            return Verdict.OTHER_VERSION
        if fields[5] != self.size:
            return Verdict.CUT_SHORT if fields[5] > self.size else Verdict.DAMAGED
        if not STATIC_BYTES <= fields[11] <= self.size:
            return Verdict.DAMAGED
        self._read_places()
        return Verdict.SOUND if self._checksum() == fields[6] else Verdict.DAMAGED

    def _checksum(self) -> int:
        total = 0xCBF29CE484222325
        static = bytes(self.map[:32]) + bytes(8) + bytes(self.map[40 : self.live])
        for byte in static:
            total = (total ^ byte) * 0x100000001B3 & 0xFFFFFFFFFFFFFFFF
        return total

    # -- registers and the directory ---------------------------------------------------

    def reg(self, r: int, field: int) -> int:
        """Return a field of a register's description; field 0 is its head."""
        return self._get(self.regs + r * _REG_BYTES + field)

    def _set_reg(self, r: int, field: int, value: int) -> None:
        self._set(self.regs + r * _REG_BYTES + field, value)

    def uid(self, r: int) -> int:
        """Return the uid of a register."""
        return self.reg(r, _UID)

    def size_of(self, v: int) -> int:
        """Return the bytes of a variable."""
        return self._get(self.vars + 24 * v)

    def keep_of(self, v: int) -> int:
        """Return the place of a variable in the keeper's group."""
        return self._get(self.vars + 24 * v + 8)

    def maxage_of(self, v: int) -> int:
        """Return the age at which a variable is stale; 0: never."""
        return self._get(self.vars + 24 * v + 16)

    def slot(self, r: int, head: int) -> int:
        """Return where the slot under a head begins."""
        return self.reg(r, _SLOTS) + head % SLOTS * self.reg(r, _STRIDE)

    def crowd(self, r: int, head: int) -> None:
        """Ask a writer to keep more commits for a while."""
        self._set_reg(r, _CROWD, (head >> 8) + 4096)

    def commit(self, r: int, group: bytes, stamp: tuple[int, int]) -> None:
        """Write a group (register.h)."""
        head = advance(self.reg(r, 0), self.reg(r, _CROWD))
        at = self.slot(r, head)
        self.map[at + LINE : at + LINE + len(group)] = group
        self.map[at : at + 16] = struct.pack("<qQ", *stamp)
        self._set_reg(r, 0, head)

    @property
    def generation(self) -> int:
        """Number of the present directory."""
        return self.dir_head >> 8

    @property
    def dir_head(self) -> int:
        """Head of the directory."""
        return self._get(self.live)

    def entry(self, v: int, head: int = 0) -> tuple[int, int, int]:
        """Return (register, live, place) of a variable."""
        reg, live, place, _ = self._stored(v, head or self.dir_head)
        return reg, live, place

    def _stored(self, v: int, head: int) -> tuple[int, int, int, int]:
        at = self.dir + head % SLOTS * self.dir_stride + LINE
        reg, live, place, total = _ENTRY.unpack_from(self.map, at + _ENTRY.size * v)
        return reg, live, place, total

    def _sum(self, v: int, entry: tuple[int, int, int]) -> int:
        """Return the check word of an entry (sound.h)."""
        r, live, place = entry
        geometry = (self.reg(r, field) for field in (_SLOTS, _STRIDE, _UID))
        words = (v, r << 32 | live, place, *geometry)
        total = sum(x * factor for x, factor in zip(words, _FACTORS, strict=True))
        return (0x9E3779B97F4A7C15 + total) % _EVER

    def sound(self) -> bool:
        """Return whether nothing has overwritten the mutable part."""
        head = self.dir_head
        at = self.dir + head % SLOTS * self.dir_stride
        guards = (self._get(self.live + place) for place in (_BEFORE, _AFTER))
        if {*guards} != {_GUARD} or self._get(at + 8) != head >> 8 or not head:
            return False
        entries = (self._stored(v, head) for v in range(self.n_vars))
        return all(
            entry[0] < self.n_regs and entry[3] == self._sum(v, entry[:3])
            for v, entry in enumerate(entries)
        )

    def _publish(self, changes: dict[int, tuple[int, int, int]]) -> None:
        head = advance(self.dir_head, _EVER)
        old = self.dir + self.dir_head % SLOTS * self.dir_stride + LINE
        new = self.dir + head % SLOTS * self.dir_stride + LINE
        size = _ENTRY.size * self.n_vars
        struct.pack_into("<qQ", self.map, new - LINE, 0, head >> 8)
        self.map[new : new + size] = self.map[old : old + size]
        for v, entry in changes.items():
            at = new + _ENTRY.size * v
            _ENTRY.pack_into(self.map, at, *entry, self._sum(v, entry))
        self._set(self.live, head)

    # -- ownership (directory.h, owner.h, keeper.h) ------------------------------------

    def _alive(self, r: int) -> bool:
        return lives(self.reg(r, _PID), self.reg(r, _START))

    def find(self, size: int) -> tuple[int, int]:
        """Return a free register and room for its slots; FULL when there is none."""
        named = {self.entry(v)[0] for v in range(self.n_vars)}
        for r in range(1, self.n_regs):
            state = self.reg(r, _STATE)
            if r not in named and (
                state == LEFT or (state != FREE and not self._alive(r))
            ):
                self._set_reg(r, _STATE, FREE)
        free = [r for r in range(1, self.n_regs) if self.reg(r, _STATE) == FREE]
        room = self._room(SLOTS * _stride(size))
        return (free[0], room) if free and room else (FULL, 0)

    def enter(self, size: int, who: tuple[int, int, bytes]) -> int:
        """Take a register; `who` is (owner, pid, task)."""
        owner, pid, task = who
        found, room = self.find(size)
        if found == FULL:
            return FULL
        uid = self._get(self.live + _UIDS) + 1
        self._set(self.live + _UIDS, uid)
        fields = {
            _SLOTS: room,
            _STRIDE: _stride(size),
            _UID: uid,
            _BYTES: size,
            _PID: pid,
        }
        fields |= {_OWNER: owner or uid, _START: process_start(pid), _STATE: HELD}
        fields |= {_CROWD: 0}
        fields[_SPACE] = space()
        for field, value in fields.items():
            self._set_reg(found, field, value)
        at = self.regs + found * _REG_BYTES + _TASK
        self.map[at : at + _TASK_BYTES] = task[:63].ljust(_TASK_BYTES, b"\0")
        return found

    def _room(self, size: int) -> int:
        used = sorted(
            (self.reg(r, _SLOTS), self.reg(r, _SLOTS) + SLOTS * self.reg(r, _STRIDE))
            for r in range(self.n_regs)
            if self.reg(r, _STATE) != FREE
        )
        at = self.arena
        for start, end in used:
            if start >= at + size:
                break
            at = max(at, end)
        return at if at + size <= self.size else 0

    def last_of(self, r: int) -> tuple[int, int]:
        """Return the uid of a register and the number of its last commit."""
        return self.uid(r), self.reg(r, 0) >> 8

    def _hands_over(self, group: Group, v: int, holder: int) -> bool:
        if group.ends is not None and group.ends[v] != self.last_of(holder):
            return False
        return self._task(holder) in group.predecessors

    def _asked(self, group: Group, r: int, v: int, to: int, *, constants: bool) -> str:
        """Return what becomes of a variable of a group that stands in `r`.

        It is taken, shared or refused; `to` is its place in the group.
        """
        holder, live, at = self.entry(v)
        if not live or holder == r or self._hands_over(group, v, holder):
            return "take"
        if not self._alive(holder):
            return "take"
        value = group.value(to, self.size_of(v))
        where = self.slot(holder, self.reg(holder, 0)) + LINE + at
        same = bytes(self.map[where : where + len(value)]) == value
        return "share" if constants and same else "refuse"

    def refused(self, group: Group, *, constants: bool) -> int | None:
        """Return the first variable that a claim would be refused for."""
        for v, at in group:
            if self._asked(group, group.reg, v, at, constants=constants) == "refuse":
                return v
        return None

    def claim(
        self, group: Group, stamp: tuple[int, int], *, constants: bool
    ) -> tuple[int, int]:
        """Commit a group and take its variables; returns (code, variable)."""
        rival = self.refused(group, constants=constants)
        if rival is not None:
            return RIVAL, rival
        group.ends = None
        old = group.reg
        if self.divided(group, constants=constants) and not self._renew(group):
            return FULL, 0
        self.commit(group.reg, group.value(0, group.bytes), stamp)
        self._set_reg(group.reg, _STATE, HELD)
        changes: dict[int, tuple[int, int, int]] = {}
        for v, at in group:
            if self._asked(group, old, v, at, constants=constants) == "take":
                changes[v] = group.reg, 1, at
        self._publish(changes)
        if group.reg != old:
            self._set_reg(old, _STATE, LEFT)
        return 0, 0

    def divided(self, group: Group, *, constants: bool) -> bool:
        """Return whether some of what a claim takes stands in the register."""
        here = [
            self.entry(v)[0] == group.reg
            for v, at in group
            if self._asked(group, group.reg, v, at, constants=constants) == "take"
        ]
        return any(here) and not all(here)

    def _renew(self, group: Group) -> bool:
        """Give a group a fresh register; False when none is left."""
        at = self.regs + group.reg * _REG_BYTES + _TASK
        task = bytes(self.map[at : at + _TASK_BYTES]).rstrip(b"\0")
        who = self.reg(group.reg, _OWNER), self.reg(group.reg, _PID), task
        code = self.enter(group.bytes, who)
        group.reg = code if code != FULL else group.reg
        return code != FULL

    def reap(self, r: int, uid: int) -> int:
        """Free what a dead process holds."""
        who = identity(self.reg(r, _PID), self.reg(r, _START), self.reg(r, _SPACE))
        ours = self.uid(r) == uid
        code = self.let_go(r, uid, leave=True, dead=True)
        if not code and ours:
            self.forget(who)
        return code

    def let_go(self, r: int, uid: int, *, leave: bool, dead: bool) -> int:
        """Give up what stands in a register."""
        if self.uid(r) != uid or self.reg(r, _STATE) == FREE:
            return 0
        if dead and self._alive(r):
            return ALIVE
        entries = {v: self.entry(v) for v in range(self.n_vars)}
        if any(reg == r and live for reg, live, _ in entries.values()):
            self._publish({v: (r, 0, e[2]) for v, e in entries.items() if e[0] == r})
        if leave:
            self._set_reg(r, _STATE, LEFT)
        return 0

    def cede(self, r: int, uid: int) -> None:
        """Mark that the task of a register has ended, unless it is another one's."""
        if self.uid(r) == uid:
            self._set_reg(r, _STATE, ENDED)
            self.count_change()

    def written(self, v: int) -> bool:
        """Return whether the owner of a variable is alive and has not ended."""
        reg, live, _ = self.entry(v)
        return bool(live) and self.reg(reg, _STATE) == HELD and self._alive(reg)

    def set(  # as the native one, which has a lock
        self, v: int, value: NDArray[Any], now: int, _wait: object = None
    ) -> int:
        """Set a variable that no task owns."""
        reg, live, _ = self.entry(v)
        if live and self._alive(reg):
            return RIVAL
        head = advance(self.reg(0, 0), _EVER)
        new, old = self.slot(0, head), self.slot(0, self.reg(0, 0))
        size = _stride(self.keep_bytes)
        self.map[new : new + size] = self.map[old : old + size]
        at = new + LINE + self.keep_of(v)
        self.map[at : at + self.size_of(v)] = bytes(value)[: self.size_of(v)]
        mark = new + LINE + self.keep_stamps + 16 * v
        times = struct.unpack_from("<Q", self.map, mark + 8)[0]
        struct.pack_into("<qQ", self.map, mark, now, times + 1)
        self._set_reg(0, 0, head)
        if reg or live:
            self._publish({v: (0, 0, self.keep_of(v))})
        return 0

    # -- looking -----------------------------------------------------------------------

    @property
    def text(self) -> bytes:
        """The variables' records."""
        return bytes(self.map[self.records : self.records + self.text_bytes])

    def stamp(self, v: int, r: int, head: int) -> tuple[int, int]:
        """Return time and cycle of a variable under a head of register `r`."""
        mark = LINE + self.keep_stamps + 16 * v if r == 0 else 0
        time_ns, cycle = struct.unpack_from("<qQ", self.map, self.slot(r, head) + mark)
        return time_ns, cycle

    def look(
        self, v: int, to: NDArray[Any]
    ) -> tuple[int, bool, int, int, int, int, str]:
        """Copy a variable and say where it comes from."""
        reg, live, at = self.entry(v)
        head = self.reg(reg, 0)
        where = self.slot(reg, head) + LINE + at
        size = self.size_of(v)
        memoryview(to)[:size] = self.map[where : where + size]
        time_ns, cycle = self.stamp(v, reg, head)
        return (
            reg,
            bool(live),
            time_ns,
            cycle,
            self.uid(reg),
            head >> 8,
            self._task(reg),
        )

    def _task(self, r: int) -> str:
        at = self.regs + r * _REG_BYTES + _TASK
        text = bytes(self.map[at : at + _TASK_BYTES])
        return text.partition(b"\0")[0].decode(errors="replace")

    def registers(self) -> list[tuple[int, int, int, int, str, int, int, bool]]:
        """Return what registers are in use."""
        return [
            (
                r,
                self.uid(r),
                self.reg(r, _OWNER),
                self.reg(r, _PID),
                self._task(r),
                self.reg(r, _BYTES),
                self.reg(r, 0) >> 8,
                self.reg(r, _STATE) != LEFT,
            )
            for r in range(1, self.n_regs)
            if self.reg(r, _STATE) != FREE
        ]
