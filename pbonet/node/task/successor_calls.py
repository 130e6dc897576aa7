"""A task's ways to its heirs on other RTPUs of the machine (`cross_core_handover`)."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError
from pbonet.node import rt

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.xm.net import Call


class Heralds:
    """The heirs that a task calls when it has ended; in the task's process.

    Args:
        open_core: Opens the table of a core by its number.
    """

    def __init__(self, open_core: Callable[[int], rt.CoreTable]) -> None:
        self._open_core = open_core
        self._ways: list[tuple[rt.CoreTable, Call]] = []
        self.gone: list[str] = []
        """Heirs that were not there any more when they were called last."""

    def learn(self, calls: list[Call]) -> list[str]:
        """Find the heirs; return those that are not to be seen from here.

        Args:
            calls: Whom to call; replaces whoever was to be called before.
        """
        self.forget()
        for call in calls:
            with contextlib.suppress(PbonetError):
                table = self._open_core(call.core)
                self._ways.append((table, call))
        return [call.heir for call in calls if not self._sees(call)]

    def _sees(self, call: Call) -> bool:
        return any(
            one is call
            and table.expects(call.slot, call.life, call.ticket, call.caller)
            for table, one in self._ways
        )

    def call(self) -> None:
        """Tell all of them that the task has ended; once."""
        self.gone = [
            call.heir
            for table, call in self._ways
            if not table.call(call.slot, call.life, call.ticket, call.caller)
        ]
        self.forget()

    def forget(self) -> None:
        """Call nobody any more."""
        for table, _ in self._ways:
            table.close()
        self._ways = []
