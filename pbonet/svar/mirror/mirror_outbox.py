"""Groups of this machine's tasks, sent to other machines when they change."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import SvarDamagedError
from pbonet.svar import PASSED_ON, layout, now_ns

from .packets import Group, News

if TYPE_CHECKING:
    from pbonet.svar import Table

    from .epochs import Epochs

TRIES = 64
"""Copies of a group that is being written, before it is left for the next check."""
KEPT = 1 << 62
"""First uid of variables that an operator set."""
BEHIND = 80_000
"""Nanoseconds after an expected commit within which it should be there."""
TOGETHER = 8
"""Commits within this fraction of a period are sent together."""
_IDLE, _BREAK, _MANY = 4, 20_000_000, 1000
"""A writer has stopped if it was silent for so many periods plus nanoseconds; the third
is the largest plausible number of commits between two checks."""
MARK = "@"
"""Separates task and host in the names of remote writers, ``TASK@HOST``."""


class OwnGroup:
    """One group of this machine."""

    def __init__(self, table: Table, uid: int, task: str, variables: list[int]) -> None:
        self.uid, self.task, self.variables = uid, task, variables
        self._table = table
        self._rooms = [room_of(table, v) for v in variables]
        self.sent = -1
        """Number of the commit that was sent last."""
        self.pause_ns = _pause(table, variables)
        self.next_ns = 0
        """Time before which nothing newer is sent."""
        self.live = False
        """Whether a task owns it, as last reported."""
        self.ended = False
        """Whether that task has ended, as last reported."""
        self._last: News | None = None
        """The state that was sent last, for a group with a limited rate."""
        self.stamp_ns = 0
        """The time stamp of the last commit that was sent."""
        self.made_ns = 0
        """When that was made; about, if its stamp is that of older data."""
        self.period_ns = 0
        """Recent time between commits; 0: unknown."""
        self.register = 0
        """Its register."""

    def sends(self, news: News, now: int) -> None:
        """Record a commit that is being sent."""
        stamp = now - news.age_ns
        made = now if news.cycle & PASSED_ON else stamp
        commits = news.seq - self.sent
        # The carrier may have been stopped between two readings of the clock.
        regular = self.task and self.sent >= 0  # an operator's next value is not due
        if regular and 0 < commits < _MANY and made > self.made_ns:
            period = (made - self.made_ns) // commits
            known = self.period_ns
            self.period_ns = (3 * known + period) // 4 if known else period
        self.sent, self.stamp_ns, self.made_ns = news.seq, stamp, made
        if self.pause_ns:
            # Counted from the due time, so that a late check costs no turn.
            late = now - self.next_ns
            kept = late if 0 < late < self.pause_ns else 0
            self.next_ns = now + self.pause_ns - kept
            self._last = news

    def again(self, now: int) -> News | None:
        """Return what was sent last; None if something newer may be sent."""
        if self._last is None or now >= self.next_ns:
            return None
        last = self._last
        age_ns = max(now - self.stamp_ns, 0)
        return News(last.uid, last.seq, age_ns, last.cycle, last.data)

    def due_ns(self, now: int) -> int | None:
        """Return when its next commit should be there; None if none is expected."""
        if not self.period_ns or now - self.made_ns > _IDLE * self.period_ns + _BREAK:
            return self.next_ns if self.next_ns > now else None
        return max(self.made_ns + self.period_ns + BEHIND, self.next_ns)

    def commit(self) -> int | None:
        """Return the number of the newest commit."""
        seen = self._table.peek(self.variables[0], self._rooms[0])
        return None if seen is None else seen[5]

    def read(self) -> News | None:
        """Return the newest commit, whole; None if the group is gone or is changing."""
        for _ in range(TRIES):
            looks = [
                self._table.peek(v, room)
                for v, room in zip(self.variables, self._rooms, strict=True)
            ]
            first = looks[0]
            if first is None:
                continue
            if all(
                update is not None and update[4:6] == first[4:6] for update in looks
            ):
                data = b"".join(self._rooms)
                return News(
                    self.uid, first[5], max(now_ns() - first[2], 0), first[3], data
                )
        return None


class Outbox:
    """The groups of this machine.

    Args:
        table: The machine's table.
        keep: Whether operators set variables on this machine.
    """

    def __init__(self, table: Table, *, keep: bool) -> None:
        self._table = table
        self._keep = keep
        self.generation = -1
        """Generation of the table at the last check."""
        self._changes = -1
        """Number of changes of the flag and of ends at the last check."""
        self.groups: dict[int, OwnGroup] = {}
        self._kept: int | None = None
        """A variable in the keeper's register, and the last commit there."""
        self._kept_seq = -1
        self._kept_room = bytearray()
        self._unset: list[tuple[int, bytearray]] = []
        """Variables that an operator may set and has not set yet."""

    def update(self, epochs: Epochs) -> bool:
        """Update the owners of variables; return whether they have changed."""
        try:
            self._table.must_be_whole()
        except SvarDamagedError:  # the RTPU process reports it
            return False
        generation = self._table.generation
        if generation == self.generation and not self._keep_grown():
            return self._note_ends()
        self.generation, self._kept, self._unset = generation, None, []
        found: dict[int, tuple[str, bool, list[int]]] = {}
        registers: dict[int, int] = {}
        for number, variable in enumerate(self._table.variables):
            room = bytearray(layout.var_bytes(variable))
            seen = self._table.peek(number, room)
            if seen is not None and seen[0] == 0 and self._keep:
                self._kept, self._kept_seq, self._kept_room = number, seen[5], room
                if seen[2] == 0:
                    self._unset.append((number, room))
            if seen is None or not self._is_own(seen):
                continue
            uid = seen[4] if seen[0] else KEPT + number
            found.setdefault(uid, (seen[6], seen[1], []))[2].append(number)
            registers[uid] = seen[0]
        epochs.here({
            v: (uid, live) for uid, (_, live, many) in found.items() for v in many
        })
        self.groups = {
            uid: self._known(uid, task, many) for uid, (task, _, many) in found.items()
        }
        for uid, group in self.groups.items():
            group.register = registers[uid]
            live = found[uid][1]
            if group.live != live:  # its first and last values are sent at once
                group.live, group.next_ns = live, 0
        self._changes = -1
        self._note_ends()
        return True

    def _note_ends(self) -> bool:
        """Note which owners have ended; return whether that has changed."""
        changes = self._table.arena.changes
        if changes == self._changes:
            return False
        self._changes = changes
        before = [group.ended for group in self.groups.values()]
        for group in self.groups.values():
            written = self._table.written(group.variables[0])
            group.ended = group.live and not written
        return before != [group.ended for group in self.groups.values()]

    def news(
        self,
        now: int,
        *,
        everything: bool = False,
        newest: bool = False,
        to_all: bool = True,
    ) -> list[News]:
        """Return what is new and due, or everything.

        Args:
            now: The time.
            everything: Repeat the last sent commit of groups that are not due.
            newest: Send the newest of everything, for a machine that has nothing yet.
            to_all: Whether all machines are sent it, so that it counts as sent.
        """
        found: list[News] = []
        for group in self.groups.values():
            if not everything and (
                now < group.next_ns or group.commit() in {None, group.sent}
            ):
                continue
            if not newest and (again := group.again(now)) is not None:
                found.append(again)
            elif (news := group.read()) is not None:
                if to_all:
                    group.sends(news, now)
                found.append(news)
        return found

    def set_value(self, variable: int, now: int) -> News | None:
        """Return the value of a variable that an operator has set, to be sent to all.

        None if the others do not know yet that it was set here, or its rate is limited.
        """
        group = self.groups.get(KEPT + variable)
        if group is None or group.pause_ns or self._table.generation != self.generation:
            return None
        if (news := group.read()) is not None:
            group.sends(news, now)
        return news

    def due(self, now: int) -> int | None:
        """Return when to check for the next commit; in the past: it is overdue.

        Commits that are expected close to each other are read together.
        """
        expected = [
            (due, group.period_ns)
            for group in self.groups.values()
            if (due := group.due_ns(now)) is not None
        ]
        if not expected:
            return None
        first = min(due for due, _ in expected)
        together = first + min((p for _, p in expected if p), default=0) // TOGETHER
        return max(due for due, _ in expected if due <= together)

    def heads(self, now: int) -> set[tuple[int, int]]:
        """Return registers where commits may come unexpectedly, and their last one."""
        heads = {
            (group.register, max(group.sent, 0))  # no commit has number 0
            for group in self.groups.values()
            if group.due_ns(now) is None
        }
        if self._kept is not None:
            heads.add((0, self._kept_seq))
        return heads

    def groups_to_send(self, epochs: Epochs) -> list[Group]:
        """Return the groups in the form in which they are sent."""
        return [
            Group(
                own.uid,
                own.task,
                own.live,
                own.variables,
                [epochs.own[v].epoch for v in own.variables],
                own.ended,
            )
            for own in self.groups.values()
        ]

    def _known(self, uid: int, task: str, variables: list[int]) -> OwnGroup:
        known = self.groups.get(uid)
        if known is not None and known.variables == variables:
            return known
        return OwnGroup(self._table, uid, task, variables)

    def _is_own(self, seen: tuple[int, bool, int, int, int, int, str]) -> bool:
        register, _, time_ns, _, _, _, task = seen
        if register == 0:  # INIT is on every machine
            return self._keep and time_ns != 0
        return MARK not in task

    def _keep_grown(self) -> bool:
        """Return whether an operator has set a variable for the first time."""
        if self._kept is None:
            return False
        seen = self._table.peek(self._kept, self._kept_room)
        if seen is None or seen[5] == self._kept_seq:
            return False
        looks = [self._table.peek(number, room) for number, room in self._unset]
        if any(update is None or update[2] for update in looks):
            return True
        self._kept_seq = seen[5]
        return False


def room_of(table: Table, number: int) -> bytearray:
    """Return room for a variable as stored in a group."""
    return bytearray(layout.var_bytes(table.variables[number]))


def _pause(table: Table, variables: list[int]) -> int:
    """Return the nanoseconds between two commits that are sent; 0: every commit is."""
    rates = [table.variables[v].rate for v in variables]
    if any(rate is None for rate in rates):
        return 0
    return round(1e9 / max(rate for rate in rates if rate is not None))


__all__ = ["MARK", "Outbox", "room_of"]
