"""Warns and signals."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Signal, UserSignal, Vector


class Talks(PortBasedObject):
    """Warns in cycle 5, sends FINISH in cycle 10, user 3 in 15, and OFF in cycle 20."""

    HALFWAY = UserSignal(3, "most of the cycles are done")

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def on(self) -> None:
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        match self.y[0]:
            case 5.0:
                self.task.warn("the fifth cycle", code=7)
            case 10.0:
                self.task.signal(Signal.FINISH, "ten")
            case 15.0:
                self.task.signal(self.HALFWAY)
            case 20.0:
                self.task.signal(Signal.OFF, "twenty is enough")
