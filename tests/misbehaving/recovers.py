"""Fails in every cycle, and each time says that it is safe to go on."""

from typing import Annotated as A

from pbonet import Answer, OutVar, PortBasedObject, Vector


class Recovers(PortBasedObject):
    """A flood of errors that are put right."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def cycle(self, dt: float) -> None:
        raise RuntimeError("always")

    def error(self, error: Exception) -> Answer:
        return Answer.CONTINUE
