"""A job in virtual time, and what tests read of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet import State
from pbonet.master.subsystem.subsystem import Subsystem

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pbonet.master.sim.sim_recording import Recording
    from pbonet.svar import Table


class VirtualJob(Subsystem):
    """A job's subsystem in virtual time, opened."""

    def __init__(self, job: str | Path, folders: Iterable[str | Path] = ()) -> None:
        self.warnings: list[str] = []
        super().__init__(
            job, libraries=[*folders], virtual=True, warned=self.warnings.append
        )
        self.open()

    @property
    def recording(self) -> Recording:
        """Every cycle so far."""
        return self.simulation.recording

    @property
    def events(self) -> list[str]:
        """What was reported so far."""
        return [*self.warnings, *self.simulation.events]

    @property
    def table(self) -> Table:
        """The table of variables."""
        (table,) = self.simulation.world.tables.values()
        return table

    def states(self) -> dict[str, State]:
        """Return the state of every task."""
        return {one.task: State(one.state) for one in self.status_all()}

    def run(self, seconds: float) -> Recording:
        """Start, let virtual time pass, stop; return every cycle of it."""
        try:
            self.start()
            self.wait(seconds)
        finally:
            self.stop()
        return self.recording

    def close(self) -> None:
        """Give the memory back."""
        self.detach()
        self.simulation.close()


def simulate(
    path: str | Path, seconds: float, folders: Iterable[str | Path] = ()
) -> Recording:
    """Run a job in virtual time and return every cycle of it."""
    job = VirtualJob(path, folders)
    try:
        recording = job.run(seconds)
    finally:
        job.close()
    recording.about["events"] = job.events
    return recording
