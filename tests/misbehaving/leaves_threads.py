"""Leaves threads: one that computes without end, one that waits without end."""

import threading
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class LeavesThreads(PortBasedObject):
    """Joins neither of them, and neither is a daemon."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        def spin() -> None:
            while True:
                pass

        threading.Thread(target=spin).start()
        threading.Thread(target=threading.Event().wait).start()

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
