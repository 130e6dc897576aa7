"""Nothing but work: so much CPU time in every cycle."""

from time import thread_time
from typing import Annotated as A

from pbonet import InVar, Params, PortBasedObject, param


class Load(Params):
    """How much."""

    work: A[float, param("s", "CPU time of a cycle", ge=0)]


class Burn(PortBasedObject[Load]):
    """Use up CPU time while told to, however long that takes."""

    go: A[int, InVar("GO", "1", "none", "whether to work")]

    def cycle(self, dt: float) -> None:  # noqa: ARG002
        """Compute until this thread has had its CPU time."""
        if self.go:
            end = thread_time() + self.params.work
            while thread_time() < end:
                pass
