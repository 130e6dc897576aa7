"""Takes the signal away by which it could be asked to end."""

import signal
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Ignores(PortBasedObject):
    """Counts, deaf."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        for which in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(which, signal.SIG_IGN)

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
