"""Admittance control of a hand that is moved by position."""

from math import sqrt
from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import difference, fault_of_pose, rotation
from pbonet.modules._dh import fault_of_wrench, shorten
from pbonet.modules._ode import propagator
from pbonet.modules._values import PerElement, spread


class Body(Params):
    """The body that the hand feels like, along and about the axes of the base."""

    mass: A[PerElement, param("mixed", "kg along x y z, kg*m^2 about them", gt=0)]
    damping: A[PerElement, param("mixed", "N*s/m of x y z, N*m*s/rad of turns", ge=0)]
    stiffness: A[PerElement, param("mixed", "N/m of x y z, N*m/rad of turns", ge=0)] = (
        0.0,
    )
    linear: A[float, param("m", "largest distance from X_REF", gt=0)] = 0.1
    angular: A[float, param("rad", "largest turn from X_REF", gt=0)] = 0.5


class Admittance(PortBasedObject[Body], module_class="controller"):
    """x_cmd = x_ref moved by e, with M e'' + D e' + K e = f.

    The hand gives way to what pushes it as a body of mass M would that a spring K and a
    damper D hold at X_REF (Hogan 1985; Seraji 1994). The equation is solved exactly
    over each cycle, in which the force counts as constant; so it is stable at any rate.
    F_MEZ is what acts on the hand, at its frame's origin in the axes of the base. Where
    e would exceed LINEAR or ANGULAR it stays there and its speed is lost. When the
    module is turned on it goes on from the X_CMD that is there, at rest, as if pushed
    so far. What is no pose, or a force that is not finite, leaves X_CMD where it is.
    """

    f: A[Vector, InVar("F_MEZ", "6", "mixed", "measured wrench, N and N*m")]
    x_ref: A[Matrix, InVar("X_REF", "3,4", "mixed", "reference pose, [R p], p in m")]
    x_cmd: A[Matrix, OutVar("X_CMD", "3,4", "mixed", "commanded pose, [R p], p in m")]

    def init(self) -> None:
        self._dt, self._step = 0.0, np.zeros((6, 3, 3))
        self._state = np.zeros((6, 3, 1))  # e, e' and the force, of each direction
        self._take_body()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_body()

    def on(self) -> None:
        self._lost = False
        self._state[:] = 0.0
        if not fault_of_pose(self.x_ref) and not fault_of_pose(self.x_cmd):
            self._state[:, 0, 0] = difference(self.x_cmd, self.x_ref)

    def cycle(self, dt: float) -> None:
        why = fault_of_pose(self.x_ref)
        why = f"X_REF is not a pose: {why}" if why else ""
        why = why or fault_of_wrench("F_MEZ", self.f)
        if why:
            if not self._lost:
                self.task.warn(f"{why}; X_CMD does not change")
            self._lost = True
            return
        self._lost = False
        self._move(dt)
        gap = self._state[:, 0, 0]
        self.x_cmd[:, :3] = rotation(gap[3:]) @ self.x_ref[:, :3]
        self.x_cmd[:, 3] = self.x_ref[:, 3] + gap[:3]

    def _move(self, dt: float) -> None:
        if dt != self._dt:
            self._dt, self._step = dt, propagator(self._law, dt)
        before = self._state[:, 0, 0].copy()
        self._state[:, 2, 0] = self.f
        self._state = self._step @ self._state
        self._bound(slice(3), before[:3], self.params.linear)
        self._bound(slice(3, 6), before[3:], self.params.angular)

    def _bound(self, part: slice, before: Vector, limit: float) -> None:
        """Stop what goes too far; what began beyond the limit may return."""
        gap, speed = self._state[part, 0, 0], self._state[part, 1, 0]
        room = max(limit, sqrt(float(before @ before)))
        if float(gap @ gap) > room * room:
            shorten(gap, room)
            speed[:] = 0.0

    def _take_body(self) -> None:
        k = self.params
        mass = spread(k.mass, 6, "mass")
        self._law = np.zeros((6, 3, 3))
        self._law[:, 0, 1] = 1.0
        self._law[:, 1, 0] = -spread(k.stiffness, 6, "stiffness") / mass
        self._law[:, 1, 1] = -spread(k.damping, 6, "damping") / mass
        self._law[:, 1, 2] = 1.0 / mass
        self._dt = 0.0
