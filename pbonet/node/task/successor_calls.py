"""The calls by which a task that has ended engages its successors (``call.h``)."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError, StateError
from pbonet.node import rt

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.xm.net import Call


class Calls:
    """The successors of a task; in the task's process.

    Args:
        core: The core table of the task.
        open_core: Opens the table of another core by its number.
    """

    def __init__(
        self, core: rt.CoreTable, open_core: Callable[[int], rt.CoreTable]
    ) -> None:
        self._core, self._open_core = core, open_core
        self._tables: list[rt.CoreTable] = []
        """Of other cores."""
        self._calls: list[tuple[rt.CoreTable, Call]] = []

    def learn(self, calls: list[Call]) -> None:
        """Find the successors, whom the next `off` with a handover engages.

        Args:
            calls: Replace those that were learned before.

        Raises:
            StateError: A successor does not stand by any more; nobody is called.
        """
        self.forget()
        self._calls = [(table, one) for one in calls if (table := self._table(one))]
        found = [call for table, call in self._calls if table.expects(*_slot(call))]
        if missing := [call.successor for call in calls if call not in found]:
            self.forget()
            raise StateError(
                f"{' and '.join(missing)} cannot take over: it does not stand by",
                expected="a successor that waits for the end of this task",
                remedy="give the swap again",
            )

    def _table(self, call: Call) -> rt.CoreTable | None:
        """Return the core table that a successor's slot is in, if it is there."""
        if call.core == self._core.core:
            return self._core
        with contextlib.suppress(PbonetError):
            self._tables.append(self._open_core(call.core))
            return self._tables[-1]
        return None

    def leave(self, slot: rt.Slot) -> list[str]:
        """Take part in no releases any more, and engage the successors.

        Returns:
            Those that have died since they were found.
        """
        heard = slot.disarm([(table, *_slot(call)) for table, call in self._calls])
        calls = zip(self._calls, heard, strict=True)
        gone = [call.successor for (_, call), there in calls if not there]
        self.forget()
        return gone

    def forget(self) -> None:
        """Call nobody any more."""
        for table in self._tables:
            table.close()
        self._tables, self._calls = [], []


def _slot(call: Call) -> tuple[int, int, int, int]:
    return call.slot, call.life, call.ticket, call.caller
