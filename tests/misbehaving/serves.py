"""Serves events: each byte on a named pipe is CPU time to spend, in milliseconds."""

import os
import time
from contextlib import nullcontext
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Place(Params):
    """Where events come from."""

    fifo: A[str, param("none", "named pipe; each byte is an event")]
    locked: A[bool, param("none", "whether an event is one critical section")] = False


class Serves(PortBasedObject[Place]):
    """y = (events served, bytes of them in all)."""

    y: A[Vector, OutVar("Y", "2", "none", "events served, their sum")]

    def init(self) -> None:
        self._fd = os.open(self.params.fifo, os.O_RDWR)

    def sync(self) -> None:
        self._byte = os.read(self._fd, 1)[0]

    def cycle(self, dt: float) -> None:
        section = self.task.critical() if self.params.locked else nullcontext()
        end = time.thread_time() + self._byte * 1e-3
        with section:
            while time.thread_time() < end:
                pass
        self.y[0] += 1.0
        self.y[1] += self._byte

    def kill(self) -> None:
        os.close(self._fd)
