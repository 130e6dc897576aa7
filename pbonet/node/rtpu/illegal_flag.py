"""An RTPU's entries in the illegal-configuration flag (Stewart 1994, section 3.10).

An entry is raised by an event: a task that others may depend on is in ERROR or dead, a
reconfiguration takes longer than a cycle, or its other part has not come. Whether it is
still valid follows from the table: it goes as soon as living tasks that have not ended
own all variables that were missing, whichever RTPU they are on. Entries without such
variables remain until they are withdrawn.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.errors import Severity, SvarError

from .task_signals import WINDOW_NS

if TYPE_CHECKING:
    from collections.abc import Collection

    from pbonet.node.wire import EventLog

    from .tables import Opened, Tables

MASTER = "master"
"""Raises the entries of a subsystem's masters."""
UNFINISHED = "unfinished"
"""Raises the entries of variables that were handed over and not taken over."""


CHANGES: Final = 6
"""Changes of one cause that are reported one by one in a window."""


class _Entry(Struct):
    """A reason for the flag to be up."""

    opened: Opened
    raiser: str
    cause: str
    missing: Collection[str] | None = None
    """Variables that no task writes; None: the entry remains until it is withdrawn."""
    by: str = ""
    """The task that has handed them over."""
    pending: bool = False
    """It is not raised yet: tasks on another RTPU may still take over."""
    generation: int = -1
    """The table's state when the entry was evaluated last."""


class _Cause(Struct):
    """A cause of the flag, and what was reported of it."""

    began_ns: int
    up: bool = False
    """As it was seen last."""
    single: int = 0
    """Reports in this window."""
    held: int = 0
    """Changes that were not reported."""


class CauseEvents:
    """Reports which causes of the flag come (ILLEGAL) and go (LEGAL).

    A cause that comes and goes again and again would hide what else happens: within a
    window only its first changes are reported one by one. How it is then, and how often
    it has changed, follows at the end of the window.

    Args:
        events: Takes the reports.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._causes: dict[str, dict[tuple[str, str], _Cause]] = {}

    def subsystems(self) -> Collection[str]:
        """Return the subsystems with causes that were reported."""
        return list(self._causes)

    def forget(self, subsystem: str) -> None:
        """Forget the causes of a subsystem whose table is gone."""
        self._causes.pop(subsystem, None)

    def update(self, subsystem: str, there: Collection[tuple[str, str]]) -> None:
        """Report what has changed, given the causes that are there, with raisers."""
        now_ns = self._events.now_ns()
        causes = self._causes.setdefault(subsystem, {})
        for key in there:
            causes.setdefault(key, _Cause(now_ns))
        for key, cause in list(causes.items()):
            if (key in there) != cause.up:
                cause.up = not cause.up
                cause.held += 1
                self._events.count(_code(cause.up), subsystem=subsystem)
            over = now_ns - cause.began_ns >= WINDOW_NS
            if cause.held and (over or cause.single < CHANGES):
                self._report(subsystem, key, cause)
            if over and not (cause.up or cause.single):
                del causes[key]
            elif over:
                cause.began_ns, cause.single = now_ns, 0

    def _report(self, subsystem: str, key: tuple[str, str], cause: _Cause) -> None:
        text = "{} ({})".format(*key) if cause.up else "no longer: {} ({})".format(*key)
        if cause.held > 1:
            text = f"[{cause.held} changes] {text}"
        self._events.count(_code(cause.up), -1, subsystem=subsystem)
        self._events.add(
            Severity.WARNING if cause.up else Severity.INFO,
            "ILLEGAL" if cause.up else "LEGAL",
            text,
            subsystem=subsystem,
        )
        cause.single += 1
        cause.held = 0


def _code(up: bool) -> str:  # noqa: FBT001 - it is what the code says
    return "ILLEGAL" if up else "LEGAL"


class Flags:
    """Causes raised by one RTPU, and on a table's keeper those of masters.

    Args:
        rtpu: Its name.
        tables: The tables that have the flags.
        events: Where to report which causes come and go.
    """

    def __init__(self, rtpu: str, tables: Tables, events: EventLog) -> None:
        self._rtpu = rtpu
        self._events = events
        self._tables = tables
        self._reports = CauseEvents(events)
        self._entries: dict[tuple[str, str, str], _Entry] = {}
        """By subsystem, name and, where a name has several, a cause or a variable."""
        self.waits = asyncio.Event()
        """Set while an entry goes when a task writes: `evaluate_if_changed` is due."""

    def up(
        self, subsystem: str, name: str, cause: str, outputs: Collection[str] = ()
    ) -> None:
        """Raise an entry.

        Args:
            subsystem: The flag's subsystem.
            name: The subject: a task, or what the RTPU does.
            cause: Why.
            outputs: Variables that no task writes now; the entry goes when all of them
                are written again.
        """
        opened = self._tables.sound(subsystem)
        if opened is None:
            return
        before = self._entries.get((subsystem, name, ""))
        missing = outputs or (before.missing if before else None)
        entry = _Entry(opened, f"{self._rtpu}/{name}", cause, missing)
        self._entries[subsystem, name, ""] = entry
        self.evaluate()

    def down(self, subsystem: str, name: str) -> None:
        """Withdraw an entry, also one raised natively; harmless without one."""
        self._entries.pop((subsystem, name, ""), None)
        opened = self._tables.sound(subsystem)
        if opened is not None:
            with contextlib.suppress(SvarError):
                self.report()
                opened.table.clear_illegal(f"{self._rtpu}/{name}")
                self.report()

    def master_found(
        self, subsystem: str, cause: str, unwritten: Collection[str]
    ) -> None:
        """Raise an entry for a master, whose knowledge of the tasks may be outdated.

        Args:
            subsystem: The flag's subsystem.
            cause: Why.
            unwritten: Variables that no task writes, as far as the master knows. The
                entry goes when all of them are written, and is not raised if they are:
                a fallback asks no master. None: the master withdraws it itself.

        Raises:
            SvarMissingError: The table is not open.
            UnknownVariableError: It has no such variable.
            SvarFullError: There is no room.
        """
        opened = self._tables.need(subsystem)
        if unwritten and self.written(subsystem, unwritten):
            self.master_mended(subsystem, cause)
            return
        opened.table.raise_illegal(cause, MASTER)
        if unwritten:
            self._entries[subsystem, MASTER, cause] = _Entry(
                opened, MASTER, cause, unwritten
            )
        self.evaluate()

    def master_mended(self, subsystem: str, cause: str) -> None:
        """Withdraw an entry of a master; harmless when there is none.

        Raises:
            SvarMissingError: The table is not open.
            SvarOwnerError: Another process has raised it, and lives.
        """
        self._entries.pop((subsystem, MASTER, cause), None)
        self._tables.need(subsystem).table.clear_illegal(MASTER, cause=cause)
        self.report()

    def written(self, subsystem: str, outputs: Collection[str]) -> bool:
        """Return whether living tasks that have not ended own all these variables."""
        opened = self._tables.sound(subsystem)
        return opened is not None and all(map(opened.table.written, outputs))

    def handed_over(
        self, subsystem: str, by: str, outputs: Collection[str], within: float = 0.0
    ) -> None:
        """Raise entries unless others take variables over by then.

        Args:
            subsystem: The subsystem of the variables.
            by: The task that has handed them over; it may own them still.
            outputs: Their names.
            within: Seconds.
        """
        opened = self._tables.sound(subsystem)
        if opened is None:
            return
        for output in outputs:
            key = subsystem, UNFINISHED, output
            if key not in self._entries or self._entries[key].pending:
                cause = f"off {by} is done, and no task took over {output}"
                raiser = f"{self._rtpu}/{UNFINISHED}"
                entry = _Entry(opened, raiser, cause, [output], by, bool(within))
                self._entries[key] = entry
                if within:
                    loop = asyncio.get_running_loop()
                    loop.call_later(within, self._due, entry)
        self.evaluate()

    def _due(self, entry: _Entry) -> None:
        """Raise an entry, if it was not withdrawn."""
        entry.pending = False
        self.evaluate()

    def decided(self, subsystem: str, handover: Collection[str] = ()) -> None:
        """Withdraw what was raised for earlier lists, because a new list was decided.

        Args:
            subsystem: The subsystem of the variables.
            handover: Tasks that hand over in the list that was decided on. What one of
                them has handed over in an earlier part of it still counts.
        """
        for (whose, *_), entry in self._entries.items():
            if whose == subsystem and entry.by and entry.by not in handover:
                entry.missing = ()
        self.evaluate()

    def owners(self, subsystem: str, outputs: Collection[str]) -> set[str]:
        """Return the tasks that own any of these variables."""
        opened = self._tables.sound(subsystem)
        if opened is None:
            return set()
        found = {opened.table.info(output).owner for output in outputs}
        return {owner for owner in found if owner}

    def report(self) -> None:
        """Report which causes have come and gone: those of this RTPU and its tasks.

        Causes that a master has raised are reported by the keeper of the table.
        """
        for subsystem in {*self._tables.subsystems(), *self._reports.subsystems()}:
            opened = self._tables.sound(subsystem)
            if opened is None:
                self._reports.forget(subsystem)
                continue
            there = {
                (cause.cause, cause.raiser): None
                for cause in opened.table.illegal
                if cause.raiser.startswith(f"{self._rtpu}/")
                or (opened.use.keep and "/" not in cause.raiser)
            }
            self._reports.update(subsystem, there)

    def evaluate_if_changed(self) -> None:
        """Evaluate again if variables have changed owners since, on any RTPU."""
        for (subsystem, *_), entry in self._entries.items():
            if self._tables.sound(subsystem) is not entry.opened or (
                entry.generation != entry.opened.table.generation
            ):
                self.evaluate()
                return

    def evaluate(self) -> None:
        """Bring the flag in line with the table.

        Entries go whose variables are written; one is raised again for which there was
        no room.
        """
        if self._entries:
            self.report()
        for key, entry in list(self._entries.items()):
            subsystem, _, several = key
            opened = entry.opened
            if self._tables.sound(subsystem) is not opened:
                del self._entries[key]
                continue
            entry.generation = opened.table.generation
            with contextlib.suppress(SvarError):  # no room: other causes hold the flag
                if entry.missing is None or not self.written(subsystem, entry.missing):
                    if not entry.pending:
                        opened.table.raise_illegal(entry.cause, entry.raiser)
                    continue
                del self._entries[key]
                one = entry.cause if several else ""
                opened.table.clear_illegal(entry.raiser, one)
        if any(entry.missing is not None for entry in self._entries.values()):
            self.waits.set()
        else:
            self.waits.clear()
        self.report()
