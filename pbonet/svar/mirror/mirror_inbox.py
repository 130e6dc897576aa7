"""Groups of other machines' tasks, written to this machine's table."""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING

from pbonet.errors import SvarError
from pbonet.svar import layout, now_ns

from .epochs import Claim
from .mirror_outbox import MARK, room_of
from .packets import NUMBERS, is_newer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.svar import LocalTable, Table

    from .packets import Full, Group, News, Packet

LONGEST_NAME = 63
"""Bytes of a task's name in a register."""
UNKNOWN_NS = 1
"""The time of values whose age is unknown: a nanosecond after boot, so they are old."""


class Counts:
    """Totals of data from a machine since this one began to receive."""

    def __init__(self) -> None:
        self.packets = 0
        self.commits = 0
        self.gaps = 0
        """Commits that were skipped: newer ones were there."""
        self.refused = 0


class RemoteGroup:
    """One group of another machine, and its copy here."""

    def __init__(self, group: Group) -> None:
        self.group = group
        self.news: News | None = None
        self.time_ns = 0
        """When it was committed, by this machine's clock."""
        self.local: LocalTable | None = None
        self.shown: tuple[int, ...] = ()

    def value(self, table: Table, variable: int) -> bytes:
        """Return the bytes of one of its variables, without padding."""
        news, record = self.news, table.variables[variable]
        if news is None:
            return b""
        at = dict(_places(table, self.group.vars))[variable]
        return news.data[at : at + record.itemsize * record.nelem]

    def drop(self) -> None:
        """Release the variables; their values remain until a task takes over."""
        if self.local is not None:
            with contextlib.suppress(SvarError):
                self.local.close()
        self.local, self.shown = None, ()


class Machine:
    """Another machine of the subsystem.

    Args:
        table: This machine's table.
        run: Number of the other carrier's run.
        host: Its host name.
    """

    def __init__(self, table: Table, run: int, host: str) -> None:
        self._table = table
        self.run, self.host = run, host
        self.state = -1
        self.groups: dict[int, RemoteGroup] = {}
        self.causes: list[tuple[str, str]] = []
        self.counts = Counts()
        self.heard_ns = now_ns()

    def take(self, packet: Packet, late_ns: int | None) -> bool:
        """Process a packet; return whether its news belong to known groups.

        Args:
            packet: The packet.
            late_ns: Its transmission time in nanoseconds; None: unknown.
        """
        self.counts.packets += 1
        self.heard_ns = now_ns()
        if packet.full is not None:
            self._restate(packet.full)
            self.state = packet.state
        now = now_ns()
        for news in packet.news:
            theirs = self.groups.get(news.uid)
            if theirs is None:
                continue
            self._count(theirs, news)
            if theirs.news is None or is_newer(news, theirs.news):
                theirs.news, theirs.time_ns = news, _time(now, news, late_ns)
                self._commit(theirs)
            elif theirs.time_ns == UNKNOWN_NS and late_ns is not None:
                theirs.time_ns = _time(now, news, late_ns)
                self._commit(theirs)
        return packet.state <= self.state

    def has(self, news: News) -> bool:
        """Return whether a value, or a newer one of its group, is in the table here."""
        theirs = self.groups.get(news.uid)
        if theirs is None or theirs.news is None or not theirs.shown:
            return False
        room = room_of(self._table, theirs.shown[0])
        seen = self._table.peek(theirs.shown[0], room)
        return seen is not None and bytes(room) == theirs.news.data

    def claims(self) -> dict[int, Claim]:
        """Return the claims of its groups, by variable."""
        return {
            variable: Claim(epoch, theirs.group.live, theirs.group.uid)
            for theirs in self.groups.values()
            for variable, epoch in zip(
                theirs.group.vars, theirs.group.epochs, strict=True
            )
        }

    def show(self, wanted: set[int]) -> None:
        """Write exactly the `wanted` variables of its groups to the table."""
        for theirs in self.groups.values():
            shown = tuple(v for v in theirs.group.vars if v in wanted)
            if shown != theirs.shown:
                theirs.drop()
                theirs.shown = shown
                self._claim(theirs)
            elif theirs.group.ended and theirs.local is not None:
                theirs.local.cede()
            elif theirs.local is None or theirs.local.claimed != theirs.group.live:
                self._claim(theirs)

    def drop(self) -> None:
        """Release everything that is in the table for it."""
        for theirs in self.groups.values():
            theirs.drop()

    def owned(self) -> list[int]:
        """Return the variables that its tasks own."""
        return [v for t in self.groups.values() if t.group.live for v in t.group.vars]

    def _restate(self, full: Full) -> None:
        groups: dict[int, RemoteGroup] = {}
        for group in full.groups:
            known = self.groups.pop(group.uid, None)
            if known is not None and known.group.vars == group.vars:
                known.group = group
                groups[group.uid] = known
            else:
                groups[group.uid] = RemoteGroup(group)
                if known is not None:
                    known.drop()
        self.drop()  # groups that no longer exist there
        self.groups, self.causes = groups, full.causes

    def _count(self, theirs: RemoteGroup, news: News) -> None:
        if theirs.news is not None and not self.kept(theirs):
            self.counts.gaps += max((news.seq - theirs.news.seq & NUMBERS) - 1, 0) * (
                is_newer(news, theirs.news)
            )

    @staticmethod
    def kept(theirs: RemoteGroup) -> bool:
        """Return whether an operator set the group, and not a task."""
        return not theirs.group.task

    def _claim(self, theirs: RemoteGroup) -> None:
        """Write a group to the table, owned here if it is owned there."""
        if not theirs.shown or theirs.news is None:
            return
        if self.kept(theirs):
            self._commit(theirs)
            return
        try:
            local = theirs.local or self._make(theirs)
            theirs.local = local
            self._fill(local, theirs)
            local.claim(theirs.time_ns, theirs.news.cycle)
            if not theirs.group.live:
                local.release()
            elif theirs.group.ended:
                local.cede()
        except SvarError:  # a task here owns one; the conflict is reported elsewhere
            self.counts.refused += 1
            theirs.drop()

    def _make(self, theirs: RemoteGroup) -> LocalTable:
        name = f"{theirs.group.task}{MARK}{self.host}"
        names = [self._table.variables[v].name for v in theirs.shown]
        text = name.encode()[:LONGEST_NAME].decode(errors="ignore")
        return self._table.local(text, os.getpid(), outvar=names)

    def _commit(self, theirs: RemoteGroup) -> None:
        news = theirs.news
        if news is None or not theirs.shown:
            return
        if self.kept(theirs):
            with contextlib.suppress(SvarError, ValueError):
                self._table.put(theirs.shown[0], news.data, theirs.time_ns)
            return
        local = theirs.local
        if local is None or not local.claimed:
            self._claim(theirs)
            return
        self._fill(local, theirs)
        flags = local.commit(theirs.time_ns, news.cycle)
        self.counts.commits += not flags
        self.counts.refused += bool(flags)

    def _fill(self, local: LocalTable, theirs: RemoteGroup) -> None:
        """Copy the shown variables of the newest commit into the local table."""
        news = theirs.news
        if news is None:
            return
        for variable, at in _places(self._table, theirs.group.vars):
            if variable in theirs.shown:
                memory = local.memory(variable)
                memory[:] = news.data[at : at + memory.nbytes]


def _time(now_ns: int, news: News, late_ns: int | None) -> int:
    """Return when values were written, by this machine's clock."""
    if late_ns is None:
        return UNKNOWN_NS
    return max(now_ns - news.age_ns - late_ns, UNKNOWN_NS)  # it may be before our start


def _places(table: Table, variables: Sequence[int]) -> list[tuple[int, int]]:
    """Return the offset of each variable in a group's data."""
    group = layout.group_of(table.variables, variables)
    return list(zip(group.indices, group.at, strict=True))


__all__ = ["Counts", "Machine", "RemoteGroup"]
