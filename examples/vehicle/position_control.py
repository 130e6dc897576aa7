"""Position control of a vehicle that takes velocities."""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, OutConst, OutVar, Params, PortBasedObject, Vector, param


class Gains(Params):
    """Gain and limit."""

    kp: A[float, param("1/s", "gain", gt=0)] = 1.0
    speed: A[float, param("m/s", "largest velocity", gt=0)] = 2.0


class PositionControl(PortBasedObject[Gains], module_class="controller"):
    """v_cmd = v_des + kp (x_des - x), at most `speed`."""

    ndof: A[int, OutConst("NDOF", "1", "none", "coordinates of a place")]
    x_des: A[Vector, InVar("X_DES", "3", "m", "desired position, NED")]
    v_des: A[Vector, InVar("X^_DES", "3", "m/s", "desired velocity, NED")]
    x: A[
        Vector,
        InVar("X_MEZ", "3", "m", "measured position", max_age=0.5, stale="safe"),
    ]
    v_cmd: A[Vector, OutVar("X^_CMD", "3", "m/s", "commanded velocity", safe=0.0)]

    def init(self) -> None:
        """Say how many coordinates a place has."""
        self.ndof = 3

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - a proportional law
        """Close the loop."""
        k = self.params
        self.v_cmd[:] = self.v_des + k.kp * (self.x_des - self.x)
        size = float(np.linalg.norm(self.v_cmd))
        if size > k.speed:
            self.v_cmd *= k.speed / size

    def off(self) -> None:
        """Stop."""
        if not self.task.handover:
            self.v_cmd[:] = 0.0
