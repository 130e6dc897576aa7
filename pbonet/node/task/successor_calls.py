"""The calls by which a task that has ended engages its successors (``call.h``)."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError, StateError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.node import rt
    from pbonet.xm.net import Call

Found = tuple["rt.CoreTable", int, int, int, int]
"""A successor's slot, in the form that `rt.Slot.disarm` takes."""


class Successors:
    """Finds the slots of a task's successors; used in the task's process.

    Args:
        core: The core table of the task.
        open_core: Opens the table of another core by its number.
    """

    def __init__(
        self, core: rt.CoreTable, open_core: Callable[[int], rt.CoreTable]
    ) -> None:
        self._core, self._open_core = core, open_core
        self._others: dict[int, rt.CoreTable] = {}
        """The opened tables of other cores, by core."""

    def find(self, calls: Sequence[Call]) -> list[Found]:
        """Return the slots of the successors to be called.

        Raises:
            StateError: A successor is no longer a standby.
        """
        found: list[Found] = []
        for call in calls:
            table = self._table(call.core)
            slot = call.slot, call.life, call.ticket, call.caller
            if table is None or not table.expects(*slot):
                raise StateError(
                    f"{call.successor} cannot take over: it is no longer a standby",
                    expected="a successor that waits for the end of this task",
                    remedy="repeat the swap",
                )
            found.append((table, *slot))
        return found

    def _table(self, core: int) -> rt.CoreTable | None:
        """Return the table of a core, if there is one."""
        if core == self._core.core:
            return self._core
        if core not in self._others:
            with contextlib.suppress(PbonetError):
                self._others[core] = self._open_core(core)
        return self._others.get(core)

    def close(self) -> None:
        """Close the tables of other cores."""
        for table in self._others.values():
            table.close()
        self._others.clear()
