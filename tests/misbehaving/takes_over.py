"""Tries in `cycle` what would take the machine along, and counts the refusals."""

import os
import signal
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class TakesOver(PortBasedObject):
    """y = (cycles, refused attempts of the six made in the third cycle)."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles, and refused attempts")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 3.0:
            self.y[1] = sum(map(self._refused, self._attempts()))

    def _attempts(self):
        forks = os.getppid()
        fields = Path(f"/proc/{forks}/stat").read_text().rpartition(")")[2].split()
        rtpu = int(fields[1])
        top = os.sched_param(99)
        return [
            lambda: os.sched_setscheduler(0, os.SCHED_FIFO, top),
            lambda: os.sched_setparam(0, top),
            lambda: os.sched_setaffinity(0, range(os.cpu_count())),
            lambda: os.kill(forks, signal.SIGKILL),
            lambda: os.kill(rtpu, signal.SIGTERM),
            lambda: os.killpg(rtpu, signal.SIGKILL),
        ]

    def _refused(self, attempt) -> bool:
        try:
            attempt()
        except PermissionError:
            return True
        return False
