"""Waits for somebody else: a synchronous module."""

import os
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Place(Params):
    """Where events come from."""

    fifo: A[str, param("none", "named pipe; each byte is an event")]


class Waits(PortBasedObject[Place]):
    """y = (events, the last one)."""

    y: A[Vector, OutVar("Y", "2", "none", "events, and the last one")]

    def init(self) -> None:
        self._fd = os.open(self.params.fifo, os.O_RDWR)

    def sync(self) -> None:
        self._byte = os.read(self._fd, 1)[0]
        if self._byte == 255:
            raise ValueError("the worst of all bytes")
        if self._byte == 254:
            self.task.fail("the second worst of all bytes")

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.y[1] = self._byte

    def off(self) -> None:
        self.y[1] = -1.0

    def kill(self) -> None:
        os.close(self._fd)
