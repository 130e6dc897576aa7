"""Processes of an agent that a signal has stopped (SIGSTOP) are continued.

A stopped RTPU process ranks no task and answers no command, and a stopped recorder
loses data when its rings are full; and while another agent of the machine is stopped,
its clients cannot be reached. A debugger holds a process in another way, and is
left alone. The RTPU process gets signs of life of the agent.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final

from pbonet.errors import Severity
from pbonet.node.wire import process_setup, rtpu_messages

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

log = logging.getLogger("pbonet.node")

PERIOD: Final = 0.2
"""Seconds between two checks."""
SELDOM: Final = 1.0
"""The same while there is no table: no task runs then, and no sign is expected."""


class StoppedProcesses:
    """Continues and reports stopped processes.

    Args:
        name: The agent's name.
        processes: Returns the identifiers of its processes, with what each one is.
        note: Called with reports for masters.
        alive: Called at each check: the RTPU process gets a sign of life.
        busy: Returns whether the RTPU has a table.
    """

    def __init__(
        self,
        name: str,
        processes: Callable[[], Mapping[int, str]],
        note: Callable[[rtpu_messages.Note], None],
        alive: Callable[[], None] = lambda: None,
        busy: Callable[[], bool] = lambda: True,
    ) -> None:
        self._name, self._processes, self._note = name, processes, note
        self._alive, self._busy = alive, busy
        self._over = False
        self._wake = threading.Event()
        self._thread = threading.Thread(
            target=self._watch, name="pbonet stopped", daemon=True
        )

    def start(self) -> None:
        """Start the checks."""
        self._thread.start()

    def stop(self) -> None:
        """End the checks."""
        self._over = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def hurry(self) -> None:
        """Check now: there may be a table."""
        self._wake.set()

    def _watch(self) -> None:
        while True:
            self._wake.wait(PERIOD if self._busy() else SELDOM)
            self._wake.clear()
            if self._over:
                return
            for pid, what in self._processes().items():
                if process_setup.resume(pid):
                    text = f"{what} (process {pid}) was stopped by a signal and has "
                    text += "been continued; to pause tasks, use 'off'"
                    log.warning("%s: %s", self._name, text)
                    note = rtpu_messages.Note(int(Severity.WARNING), "RESUMED", text)
                    self._note(note)
            self._alive()  # after that, since it waits for a process that is stopped
