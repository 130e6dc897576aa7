"""Another: takes what `beats` writes from a link, and judges each record."""

import time
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param, tbuf

ALIKE = 0.02
"""Seconds by which an age may differ from the time that has passed."""


class Link(Params):
    """Which link it is."""

    link: A[str, param("none", "its name")]


class HearsBeats(PortBasedObject[Link]):
    """y = (first, last, taken, lost, wrong, aged, starts, age of the last one).

    Wrong are records out of order, twice, or with what another one should hold. Aged
    are those whose age is the time that has passed, by a clock that all hosts share.
    """

    y: A[Vector, OutVar("Y", "8", "none", "what was judged")]

    def init(self) -> None:
        self._link = tbuf.Reader(self.params.link, ("f8", 2))

    def on(self) -> None:
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        link, y = self._link, self.y
        new = link.read()
        now, age = time.time(), (link.age_ns() or 0) * 1e-9
        y[3], y[6], y[7] = link.lost, link.restarts, age
        if new:
            count, written = link.value
            y[0] = y[0] or count
            y[4] += not (count == link.number > y[1])
            y[5] += abs(now - written - age) < ALIKE
            y[1] = count
            y[2] += 1.0

    def kill(self) -> None:
        self._link.close()
