"""Warns and signals in every cycle."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Signal, Vector


class Warns(PortBasedObject):
    """y = (cycles, missed ones)."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles, and missed ones")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.y[1] += round(dt * self.task.freq) - 1
        self.task.warn(f"again {self.y[0]:.0f}")
        self.task.signal(Signal.FINISH, "and again")
