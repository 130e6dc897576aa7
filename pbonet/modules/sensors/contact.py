"""Which feet of a legged robot touch, from the torques of its joints."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.errors import ParameterError
from pbonet.io import FloatingModel, all_finite
from pbonet.modules._legs import fault_of_base, fault_of_joints, must_have_feet
from pbonet.modules._values import keep
from pbonet.modules._warn_once import WarnOnce

WELL_FELT = 1.2
"""Square of a lever, that of SIGMA being 1, from which a leg is not stretched now."""


class Touch(Params):
    """The robot, and what counts as a touch."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    feet: A[tuple[str, ...], param("none", "frames of the feet")]
    gain: A[float, param("1/s", "how fast the observer follows", gt=0)] = 100.0
    touch: A[float, param("N", "force upwards, from which a foot touches", gt=0)] = 15.0
    leave: A[float, param("N", "force upwards, below which it does not", ge=0)] = 8.0
    sigma: A[
        float, param("m", "lever at a foot, below which its force is damped", gt=0)
    ] = 0.02


class Contact(PortBasedObject[Touch], module_class="sensor"):
    """r' = gain * (p' - tau - C^T v + g + d qd - r), and J^T f = r for the feet.

    The observer of De Luca and Mattone (2003), at the joints of a robot whose base
    moves: p are their momenta M v, and r follows the torques that come from outside.
    What pushes the base does not appear there. The forces f act at the origins of the
    frames FEET, in the axes of the world; J are the joints' columns of their Jacobian.
    Where a leg is so stretched that the joints feel less than SIGMA metres of a
    direction, its force fades in that direction, and a warning names the foot: once,
    until no leg is near that any more. A foot touches from TOUCH upwards, until its
    force is below LEAVE. The first force is the one in the table. A measurement that is
    not finite ends in ERROR.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p], p in m")]
    v: A[Vector, InVar("X^_MEZ", "6", "mixed", "its velocity, m/s and rad/s")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    tau: A[
        Vector, InVar("T_MEZ", "ndof", "N*m", "torque that acted since the last cycle")
    ]
    contact: A[Vector, OutVar("CONTACT", "nfeet", "none", "1 for a foot that touches")]
    force: A[Matrix, OutVar("F_FEET", "nfeet,3", "N", "force on each foot, z upwards")]

    def init(self) -> None:
        k, n = self.params, len(self.contact)
        self._model = FloatingModel(k.urdf, self.task.libraries)
        self._model.joints.must_have(self.ndof)
        must_have_feet(self._model.joints, k.feet, n, "CONTACT")
        self._frames = [self._model.frame(name) for name in k.feet]
        self._levers = np.zeros((self.ndof, 3 * n))
        self._told = WarnOnce(self.task)
        self._stretched: set[int] = set()
        self._check()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "feet"})
        self._check()

    def on(self) -> None:
        self._told.clear()
        self._stretched.clear()
        self._begins = True

    def cycle(self, dt: float) -> None:
        model = self._model
        there = model.move(self.x, self.v, self.q, self.qd)
        if not there or not all_finite(self.tau):
            self.task.fail(self._fault())
            return
        model.levers(self._frames, self._levers)
        momentum, drift = model.momentum()
        if self._begins:
            self._begins = False
            self._r = self._levers @ self.force.ravel()
        else:
            self._observe(momentum, drift, dt)
        self._momentum, self._drift = momentum, drift
        self.force[:] = self._forces().reshape(-1, 3)
        up = self.force[:, 2]
        self.contact[up < self.params.leave] = 0.0
        self.contact[up >= self.params.touch] = 1.0

    def _observe(self, momentum: Vector, drift: Vector, dt: float) -> None:
        """Follow the torques from outside, by the mean drift of this cycle."""
        gained = momentum - self._momentum
        gained -= dt * (self.tau + 0.5 * (drift + self._drift))
        k = self.params.gain
        self._r = (self._r + k * gained) / (1.0 + k * dt)

    def _forces(self) -> Vector:
        """Return the forces at the feet, damped where the joints do not feel them."""
        squares, axes = np.linalg.eigh(self._levers.T @ self._levers)
        limit = self.params.sigma**2
        missing = np.maximum(1.0 - squares / limit, 0.0)
        damped = np.maximum(squares, 0.0) + missing * limit
        self._warn_stretched(squares / limit, axes)
        felt = axes.T @ (self._levers.T @ self._r)
        forces: Vector = axes @ (felt / damped)
        return forces

    def _warn_stretched(self, felt: Vector, axes: Matrix) -> None:
        """Report once which feet the joints do not feel in some direction.

        Args:
            felt: Square of the lever along each axis, and that of SIGMA is 1.
            axes: The axes, in the space of all feet's forces.
        """
        if felt[0] >= WELL_FELT:
            self._told.clear()
            self._stretched.clear()
        if not felt[0] < 1.0:
            return
        share = (axes[:, felt < 1.0] ** 2).sum(axis=1).reshape(-1, 3).sum(axis=1)
        # axes of legs that are stretched alike belong to all of them
        self._stretched.update(np.flatnonzero(share > 0.5 * share.max()).tolist())
        feet = " and of ".join(self.params.feet[k] for k in sorted(self._stretched))
        self._told.warn(
            feet,
            f"the leg of {feet} is stretched or singular: its force is not felt in one "
            "direction, and fades there",
        )

    def _fault(self) -> str:
        names = self._model.joints.joints
        return (
            fault_of_base(self.x, self.v)
            or fault_of_joints("Q_MEZ", self.q, names)
            or fault_of_joints("Q^_MEZ", self.qd, names)
            or fault_of_joints("T_MEZ", self.tau, names)
        )

    def _check(self) -> None:
        k = self.params
        if k.leave >= k.touch:
            raise ParameterError(
                "a foot would touch and not touch at the same time",
                expected=f"LEAVE below TOUCH, {k.touch:g} N",
                got=f"LEAVE {k.leave:g} N",
                remedy="raise TOUCH, or lower LEAVE",
            )
