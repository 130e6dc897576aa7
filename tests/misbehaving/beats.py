"""A good neighbour: puts its cycles, and when each was, into a link."""

import time
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param, tbuf


class Link(Params):
    """Which link it is."""

    link: A[str, param("none", "its name")]


class Beats(PortBasedObject[Link]):
    """y = (records that were written, 0)."""

    y: A[Vector, OutVar("Y", "2", "none", "records that were written")]

    def init(self) -> None:
        self._link = tbuf.Writer(self.params.link, ("f8", 2))

    def on(self) -> None:
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self._link.value[:] = self.y[0], time.time()
        self._link.write()

    def kill(self) -> None:
        self._link.close()
