"""Hybrid control of force and position of a hand that is moved by position."""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import difference, fault_of_pose, rotation
from pbonet.modules._dh import fault_of_wrench
from pbonet.modules._values import PerElement, spread


class Contact(Params):
    """The directions in which force is controlled, and how."""

    select: A[
        PerElement, param("none", "1: force, 0: position; x y z, turns", ge=0, le=1)
    ]
    gain: A[PerElement, param("mixed", "m/s per N of x y z, rad/s per N*m", ge=0)]
    speed: A[PerElement, param("mixed", "largest m/s of x y z, rad/s", gt=0)]
    reach: A[PerElement, param("mixed", "largest m of x y z from X_REF, rad", gt=0)]


class HybridForce(PortBasedObject[Contact], module_class="controller"):
    """x_cmd = x_ref moved by e, with e' = select gain (f_des + f).

    In the directions of SELECT the hand presses with F_DES, in the others it goes where
    X_REF says (Mason 1981; Raibert and Craig 1981). F_MEZ is what acts on the hand, so
    at rest it is -F_DES; both are in the axes of the base. Where nothing is in the way
    the hand seeks it, not faster than SPEED and not further from X_REF than REACH. When
    the module is turned on it goes on from the X_CMD that is there: what lies in
    directions of force stays, what lies in the others goes at SPEED. What is no pose,
    or a force that is not finite, leaves X_CMD where it is.
    """

    f_des: A[Vector, InVar("F_DES", "6", "mixed", "wrench to press with, N and N*m")]
    f: A[Vector, InVar("F_MEZ", "6", "mixed", "measured wrench, N and N*m")]
    x_ref: A[Matrix, InVar("X_REF", "3,4", "mixed", "reference pose, [R p], p in m")]
    x_cmd: A[Matrix, OutVar("X_CMD", "3,4", "mixed", "commanded pose, [R p], p in m")]

    def init(self) -> None:
        self._gap = np.zeros(6)
        self._take_contact()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_contact()

    def on(self) -> None:
        self._lost = False
        self._gap[:] = 0.0
        if not fault_of_pose(self.x_ref) and not fault_of_pose(self.x_cmd):
            self._gap[:] = difference(self.x_cmd, self.x_ref)

    def cycle(self, dt: float) -> None:
        why = fault_of_pose(self.x_ref)
        why = f"X_REF is not a pose: {why}" if why else ""
        why = why or fault_of_wrench("F_DES", self.f_des)
        why = why or fault_of_wrench("F_MEZ", self.f)
        if why:
            if not self._lost:
                self.task.warn(f"{why}; X_CMD does not change")
            self._lost = True
            return
        self._lost = False
        most = self._speed * dt
        step = np.where(
            self._select, self._gain * (self.f_des + self.f) * dt, -self._gap
        )
        room = np.maximum(self._reach, np.abs(self._gap))  # what is beyond may return
        self._gap += np.clip(step, -most, most)
        np.clip(self._gap, -room, room, out=self._gap)
        self.x_cmd[:, :3] = rotation(self._gap[3:]) @ self.x_ref[:, :3]
        self.x_cmd[:, 3] = self.x_ref[:, 3] + self._gap[:3]

    def _take_contact(self) -> None:
        k = self.params
        self._select = spread(k.select, 6, "select") > 0.5  # noqa: PLR2004 - 0 or 1
        self._gain = spread(k.gain, 6, "gain")
        self._speed = spread(k.speed, 6, "speed")
        self._reach = spread(k.reach, 6, "reach")
