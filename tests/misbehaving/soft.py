"""Takes as much CPU time as its plan says, cycle after cycle."""

import time
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Plan(Params):
    """CPU time of the cycles, which comes round again and again."""

    plan: A[tuple[float, ...], param("s", "CPU time of the cycles in turn")]


class Soft(PortBasedObject[Plan]):
    """A cycle that now and then takes more than its effective time."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles that ended, and nothing")]

    def cycle(self, dt: float) -> None:
        plan = self.params.plan
        end = time.thread_time() + plan[int(self.y[0]) % len(plan)]
        while time.thread_time() < end:
            pass
        self.y[0] += 1.0
