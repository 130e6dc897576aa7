"""The example's subsystem in real or in virtual time, and every cycle of its tasks."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from pbonet import Subsystem
from pbonet.errors import StateError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.log import Cycles


class Steering:
    """One run of a job, recorded.

    Args:
        job: The job's file.
        sim: In virtual time: the same result every time.
        domain: Where agents run already; by default a new one with agents of its own.
    """

    def __init__(self, job: Path, *, sim: bool = False, domain: str = "") -> None:
        self.subsystem = Subsystem(
            job,
            domain=domain or f"servoing{os.getpid()}",
            embed=not sim,
            virtual=sim,
        )

    def begin(self, spare: Sequence[tuple[str, str]]) -> None:
        """Start the job, and create more tasks (RMOD and RTPU) that stay OFF."""
        arm = self.subsystem.open()
        try:
            arm.start()
            for rmod, rtpu in spare:
                arm.spawn(rmod, rtpu)
        except BaseException:
            self.end()
            raise
        self._begin = arm.clock.now()

    def value(self, variable: str) -> float:
        """Return the first element of a variable."""
        return float(self.subsystem.display(variable)[0].values[0])

    def now(self) -> float:
        """Return seconds since the job was started."""
        return self.subsystem.clock.now() - self._begin

    def end(self) -> Cycles:
        """Turn everything off; return every cycle."""
        arm = self.subsystem
        arm.finish()
        if arm.simulation is not None:
            return arm.simulation.recording
        log = arm.recordings.log()
        if log is None:
            raise StateError("the job was never started", where=arm.name)
        return log
