"""Constants that have changed owners before the exchange of tasks.

With `swap` and `switch` the new task takes over the constants as soon as it exists; the
tasks are exchanged later (decision 0110). If the master dies in between, the old task
runs with constants of a task that is OFF. The RTPU of the new task reports this.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from msgspec import Struct

from pbonet.pbo import State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .illegal_flag import Flags
    from .task_handle import Task

RAISER = "constants"
PATIENCE = 5.0
"""Seconds without a message from the master after which it counts as gone."""


class Home(Protocol):
    """The part of the RTPU that is needed here."""

    flags: Flags
    tasks: dict[tuple[str, str], Task]


class ConstantOwner(Struct):
    """A task that provides constants in place of others."""

    task: Task
    olds: list[str]
    master_seen: float
    """The time of the master's last message."""
    reported: bool = False


class ConstantOwners:
    """The tasks of one RTPU that have taken constants over.

    Args:
        rtpu: The RTPU.
    """

    def __init__(self, rtpu: Home) -> None:
        self._rtpu = rtpu
        self._owned_constants: list[ConstantOwner] = []

    def took_over(self, task: Task, olds: Sequence[str]) -> None:
        """Note that a task provides the constants of others from now on."""
        for giver in list(self._owned_constants):
            same = giver.task.facts.subsystem == task.facts.subsystem
            if same and (giver.task is task or giver.task.name in olds):
                self._end(giver)
        if olds:
            self._owned_constants.append(
                ConstantOwner(task, list(olds), time.monotonic())
            )

    def note_master(self, subsystem: str) -> None:
        """Note that the master of a subsystem continues."""
        for giver in self._owned_constants:
            if giver.task.facts.subsystem == subsystem:
                giver.master_seen = time.monotonic()

    def check(self) -> None:
        """Raise the flag where no master continues, and withdraw it once one does."""
        for giver in list(self._owned_constants):
            left = self._on(giver)
            if giver.task.gone.is_set() or not left:
                self._end(giver)
            elif not giver.reported and time.monotonic() - giver.master_seen > PATIENCE:
                giver.reported = True
                verb = "is" if len(left) == 1 else "are"
                cause = f"{giver.task.name} gives the constants of {' and '.join(left)}"
                cause += f", which {verb} still ON: no master continues the exchange"
                self._rtpu.flags.up(giver.task.facts.subsystem, RAISER, cause)

    def _on(self, giver: ConstantOwner) -> list[str]:
        """Return those that are ON, here or, as their variables tell, elsewhere."""
        subsystem, flags = giver.task.facts.subsystem, self._rtpu.flags
        owners = flags.owners(subsystem, giver.task.facts.outputs)
        tasks = {old: self._rtpu.tasks.get((subsystem, old)) for old in giver.olds}
        return [
            old
            for old, task in tasks.items()
            if old in owners or (task is not None and task.state is State.ON)
        ]

    def _end(self, giver: ConstantOwner) -> None:
        self._owned_constants.remove(giver)
        if giver.reported:
            self._rtpu.flags.down(giver.task.facts.subsystem, RAISER)
