"""An RTPU's entries in the illegal-configuration flag (Stewart 1994, section 3.10).

An entry stands while a task that others may depend on is in ERROR or dead, while a
reconfiguration takes longer than a cycle, or when its other part has not come. It goes
when the task recovers, is killed or spawned again, or when all it wrote is written by
others.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import Severity, SvarError, SvarFullError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from pbonet.node.wire import EventLog

    from .tables import Opened, Tables

MASTER = "master"
"""Raises the entries of a subsystem's masters."""
UNFINISHED = "unfinished"
"""Raises the entry of a list whose other part, on another RTPU, has not come."""


class _Handed(Struct):
    """A variable that a list has handed over."""

    by: str
    """The task that wrote it."""


class _Unfed(Struct):
    """A master's finding: inputs without a writer."""

    opened: Opened
    """The table whose flag is up for it."""
    variables: Collection[str]


class Flags:
    """Causes raised by one RTPU, and on a table's keeper those of masters.

    Args:
        rtpu: Its name.
        tables: The tables that have the flags.
        events: Where to tell which causes come and go.
    """

    def __init__(self, rtpu: str, tables: Tables, events: EventLog) -> None:
        self._rtpu = rtpu
        self._events = events
        self._seen: dict[str, dict[tuple[str, str], None]] = {}
        """Causes and raisers that stood at the last look, by subsystem."""
        self._tables = tables
        self._outputs: dict[tuple[str, str], Collection[str]] = {}
        self._refused: dict[tuple[str, str], str] = {}
        """Causes for which there was no room; raised again when others have gone."""
        self._ceded: dict[str, dict[int, int]] = {}
        """What tasks wrote last that have ended and whose heir has failed: by subsystem
        the number of a commit for each register."""
        self._handed: dict[tuple[str, str], _Handed] = {}
        """Variables that lists have handed over; those for which nobody has come are
        among the outputs of the entry `UNFINISHED`."""
        self._unfed: dict[tuple[str, str], _Unfed] = {}
        """Entries of masters that go by themselves, by subsystem and cause."""

    def up(
        self, subsystem: str, name: str, cause: str, outputs: Collection[str] = ()
    ) -> None:
        """Raise an entry.

        Args:
            subsystem: Whose flag.
            name: Who it is about: a task, or what the RTPU does.
            cause: Why.
            outputs: Variables that nobody writes now; the entry goes when all of them
                are written again.
        """
        opened = self._tables.sound(subsystem)
        if opened is None:
            return
        if outputs:
            self._outputs[subsystem, name] = outputs
        self._refused.pop((subsystem, name), None)
        try:
            opened.table.raise_illegal(cause, self._raiser(name))
        except SvarFullError:  # other causes hold the flag up meanwhile
            self._refused[subsystem, name] = cause
        except SvarError:
            pass  # the table is gone, and with it the flag
        self.look()

    def down(self, subsystem: str, name: str) -> None:
        """Withdraw an entry, told if it was raised natively; harmless without one."""
        self._outputs.pop((subsystem, name), None)
        self._refused.pop((subsystem, name), None)
        opened = self._tables.sound(subsystem)
        if opened is not None:
            with contextlib.suppress(SvarError):
                self.look()
                opened.table.clear_illegal(self._raiser(name))
                self.look()

    def narrow(self, subsystem: str, name: str, outputs: Collection[str]) -> None:
        """Have an entry go when those of its outputs are written that are among these.

        Args:
            subsystem: Whose flag.
            name: The task that the entry is about; harmless when there is none.
            outputs: What the task's fallback writes, which has taken its place.
        """
        stands = self._outputs.get((subsystem, name))
        if stands is not None:
            left = [output for output in stands if output in outputs]
            self._outputs[subsystem, name] = left

    def master_found(self, subsystem: str, cause: str, unfed: Collection[str]) -> None:
        """Raise an entry for a master, whose look at the tasks may be an old one.

        Args:
            subsystem: Whose flag.
            cause: Why.
            unfed: Variables that nobody writes, as the master knows. The entry goes
                when all of them are written, and is not raised if they are: a fallback
                asks no master. None: the master withdraws it itself.

        Raises:
            SvarMissingError: The table is not open.
            UnknownVariableError: It has no such variable.
            SvarFullError: There is no room.
        """
        opened = self._tables.need(subsystem)
        if unfed and self.written(subsystem, unfed):
            self.master_mended(subsystem, cause)
            return
        opened.table.raise_illegal(cause, MASTER)
        if unfed:
            self._unfed[subsystem, cause] = _Unfed(opened, unfed)
        self.look()

    def master_mended(self, subsystem: str, cause: str) -> None:
        """Withdraw an entry of a master; harmless when there is none.

        Raises:
            SvarMissingError: The table is not open.
            SvarOwnerError: Another process has raised it, and lives.
        """
        self._unfed.pop((subsystem, cause), None)
        self._tables.need(subsystem).table.clear_illegal(MASTER, cause=cause)
        self.look()

    def written(
        self, subsystem: str, outputs: Collection[str], *, but: str = ""
    ) -> bool:
        """Tell whether tasks own all of these variables, and other ones than `but`.

        Those that have ended, and wait for an heir that will not come, are none.
        """
        opened = self._tables.sound(subsystem)
        if opened is None:
            return False
        gone = self._ceded.get(subsystem, {})
        found = [opened.table.info(output) for output in outputs]
        return all(
            one.owner not in {None, but} and gone.get(one.register) != one.seq
            for one in found
        )

    def ceded(self, subsystem: str, outputs: Collection[str]) -> None:
        """Take note that whoever owns variables has ended, and nobody takes over."""
        opened = self._tables.sound(subsystem)
        if opened is not None:
            owned = [opened.table.info(output) for output in outputs]
            last = {one.register: one.seq for one in owned}
            self._ceded.setdefault(subsystem, {}).update(last)

    def expect(
        self, subsystem: str, outputs: Mapping[str, str], done: str, within: float
    ) -> None:
        """Raise an entry unless others have taken variables over by then.

        Those that others write already are done with, whatever comes behind that.

        Args:
            subsystem: Whose variables.
            outputs: Their names, and which task each was handed over by.
            done: What of the list is done.
            within: Seconds.
        """
        handed: dict[tuple[str, str], _Handed] = {}
        for output, by in outputs.items():
            self._handed.pop((subsystem, output), None)
            if not self.written(subsystem, [output], but=by):
                handed[subsystem, output] = _Handed(by)
        if not handed:
            return
        self._handed |= handed

        def look() -> None:
            due = [key for key, one in handed.items() if self._handed.get(key) is one]
            self._unfinished(subsystem, [output for _, output in due], done)

        asyncio.get_running_loop().call_later(within, look)

    def abandoned(self, subsystem: str, by: str, outputs: Collection[str]) -> None:
        """Raise an entry: a task is off, and who was to take over will not come.

        Args:
            subsystem: Whose variables.
            by: The task that has handed them over; it may own them still.
            outputs: Their names.
        """
        self._handed |= {(subsystem, output): _Handed(by) for output in outputs}
        self.ceded(subsystem, outputs)
        self._unfinished(subsystem, outputs, f"off {by}")

    def _unfinished(self, subsystem: str, outputs: Collection[str], done: str) -> None:
        """Raise an entry for those of them that nobody writes, if they have none."""
        before = self._outputs.get((subsystem, UNFINISHED), ())
        left = [
            output
            for output in outputs
            if output not in before and not self.written(subsystem, [output])
        ]
        if left:
            what = f"{done} is done, and nobody took over {' '.join(left)}"
            self.up(subsystem, UNFINISHED, what, [*before, *left])

    def decided(self, subsystem: str, handover: Collection[str] = ()) -> None:
        """Look no more at what was handed over before: what comes was decided anew.

        Args:
            subsystem: Whose variables.
            handover: Tasks that hand over in the list that was decided on. What one of
                them has handed over in an earlier part of it is looked at still.
        """
        for key, one in list(self._handed.items()):
            if key[0] == subsystem and one.by not in handover:
                del self._handed[key]
        raised = self._outputs.get((subsystem, UNFINISHED), ())
        left = [output for output in raised if (subsystem, output) in self._handed]
        if left:
            self._outputs[subsystem, UNFINISHED] = left
        else:
            self.down(subsystem, UNFINISHED)

    def forget(self, subsystem: str) -> None:
        """Forget what was handed over: all tasks of the subsystem have ended."""
        self._ceded.pop(subsystem, None)
        self.decided(subsystem)

    def owners(self, subsystem: str, outputs: Collection[str]) -> set[str]:
        """Return the tasks that own any of these variables."""
        opened = self._tables.sound(subsystem)
        if opened is None:
            return set()
        found = {opened.table.info(output).owner for output in outputs}
        return {owner for owner in found if owner}

    def look(self) -> None:
        """Tell which causes have come and gone: those of this RTPU and its tasks.

        What a master has raised is told by the keeper of the table.
        """
        for subsystem in {*self._tables.subsystems(), *self._seen}:
            opened = self._tables.sound(subsystem)
            before = self._seen.pop(subsystem, {})
            if opened is None:
                continue
            now = {
                (cause.cause, cause.raiser): None
                for cause in opened.table.illegal
                if cause.raiser.startswith(f"{self._rtpu}/")
                or (opened.keep and "/" not in cause.raiser)
            }
            self._seen[subsystem] = now
            self._tell(subsystem, now.keys() - before, up=True)
            self._tell(subsystem, before.keys() - now, up=False)

    def _tell(
        self, subsystem: str, causes: Collection[tuple[str, str]], *, up: bool
    ) -> None:
        for cause, raiser in causes:
            text = f"{cause} ({raiser})"
            self._events.add(
                Severity.WARNING if up else Severity.INFO,
                "ILLEGAL" if up else "LEGAL",
                text if up else f"no longer: {text}",
                subsystem=subsystem,
            )

    def relieve(self) -> None:
        """Withdraw entries for outputs that others write now; raise refused ones."""
        for (subsystem, name), cause in list(self._refused.items()):
            self.up(subsystem, name, cause)
        for (subsystem, name), outputs in list(self._outputs.items()):
            opened = self._tables.sound(subsystem)
            if opened is None:
                del self._outputs[subsystem, name]
            elif self.written(subsystem, outputs, but=name):
                self.down(subsystem, name)
        self._relieve_masters()
        self.look()

    def _relieve_masters(self) -> None:
        """Withdraw masters' entries for inputs that tasks write now."""
        for (subsystem, cause), unfed in list(self._unfed.items()):
            if self._tables.sound(subsystem) is not unfed.opened:
                del self._unfed[subsystem, cause]
            elif self.written(subsystem, unfed.variables):
                with contextlib.suppress(SvarError):
                    self.master_mended(subsystem, cause)

    def _raiser(self, name: str) -> str:
        return f"{self._rtpu}/{name}"
