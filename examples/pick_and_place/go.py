"""Brings the tip of the tool to a place, in a straight line and pointing down."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    Vector,
    param,
)

DOWN = np.diag([-1.0, 1.0, -1.0])
SHORTEST = 0.2
"""Seconds that any motion takes."""


class Way(Params):
    """Where to, and how."""

    x: A[float, param("m", "where the tip goes, in the arm's base")]
    y: A[float, param("m", "where the tip goes")]
    z: A[float, param("m", "where the tip goes")]
    speed: A[float, param("m/s", "fastest", gt=0)] = 0.35
    near: A[float, param("m", "the hand has arrived when so near", gt=0)] = 0.002


class Go(PortBasedObject[Way]):
    """x_des goes from where it stands to the goal, with the least jerk; then FINISH.

    The tool's length is a constant: with another tool the hand goes elsewhere, so that
    the tip comes to the same place.
    """

    length: A[float, InConst("TOOL_LENGTH", "1", "m", "from the hand to the tip")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "measured pose of the hand")]
    x_des: A[Matrix, OutVar("X_DES", "3,4", "mixed", "desired pose of the hand")]
    goal: A[Vector, OutVar("GOAL", "3", "m", "where the tip is to be")]

    def init(self) -> None:
        """Stand still until it is turned on."""
        self._time, self._seconds, self._told = 0.0, SHORTEST, True

    def on(self) -> None:
        """Begin."""
        self._begin()

    def reinit(self) -> None:
        """Begin again, with another tool."""
        if self.task.state == "ON":
            self._begin()

    def cycle(self, dt: float) -> None:
        """Go a little farther; tell once that the hand has arrived."""
        self._time = min(self._time + dt, self._seconds)
        share = self._time / self._seconds
        share *= share * share * (10.0 - share * (15.0 - 6.0 * share))
        self.x_des[:, :3] = DOWN
        self.x_des[:, 3] = self._from + share * (self._to - self._from)
        away = float(np.linalg.norm(self.x[:, 3] - self._to))
        if not self._told and self._time == self._seconds and away < self.params.near:
            self._told = True
            self.task.signal(Signal.FINISH, "arrived")

    def _begin(self) -> None:
        """Begin where X_DES stands, whoever wrote it."""
        k = self.params
        self.goal[:] = k.x, k.y, k.z
        self._from = self.x_des[:, 3].copy()
        self._to = self.goal - self.length * DOWN[:, 2]
        far = float(np.linalg.norm(self._to - self._from))
        self._seconds = max(1.875 * far / k.speed, SHORTEST)
        self._time, self._told = 0.0, False
