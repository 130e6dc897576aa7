"""Another: acts on what `tells_time` has written, and records how old that was."""

import time
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector


class ActsOnTime(PortBasedObject):
    """y = (age in s of the oldest input that a cycle acted on, number of `stable`)."""

    z: A[Vector, InVar("Z", "2", "none", "when it was written")]
    y: A[Vector, OutVar("Y", "2", "none", "the oldest input, calls of stable")]

    def on(self) -> None:
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        self.y[0] = max(self.y[0], time.time() - self.z[0])

    def stable(self, dt: float) -> None:
        self.y[1] += 1.0
