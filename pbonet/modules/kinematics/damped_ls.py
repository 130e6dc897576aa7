"""Cartesian velocity control by damped least squares, for any arm."""

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
from pbonet.io import difference, fault_of_pose
from pbonet.modules._dh import scale, shorten
from pbonet.modules._values import rest
from pbonet.modules._warn_once import WarnOnce

MOST_GAIN = 0.5
"""Share of the error that a cycle takes at most; X_MEZ may be of the cycle before."""


class Damping(Params):
    """Gains, damping near a singularity, and speed limits."""

    gain: A[float, param("1/s", "gain of the error, at most half per cycle", gt=0)] = (
        4.0
    )
    sigma: A[
        float, param("none", "singular value above which there is no damping", gt=0)
    ] = 0.2
    damping: A[float, param("none", "damping at the singularity", gt=0)] = 0.2
    linear: A[float, param("m/s", "largest commanded linear speed", gt=0)] = 0.5
    angular: A[float, param("rad/s", "largest commanded angular speed", gt=0)] = 1.5
    joint_accel: A[
        float, param("rad/s^2", "how fast a joint's velocity may change", gt=0)
    ] = 20.0
    length: A[float, param("m", "counts as much as one radian", gt=0)] = 0.2
    short: A[float, param("m/s", "speed that may be missing unreported", gt=0)] = 0.01


class DampedLS(PortBasedObject[Damping], module_class="kinematics"):
    """qd = J'(J J' + L)^-1 v, with v = gain * (x_des - x) + xd_des and damping L.

    Least squares that weigh the hand's error against the joints' speed (Nakamura and
    Hanafusa 1986; Wampler and Leifer 1988). Each direction of the hand is damped by how
    well the arm can move there, its singular value s: not at all while s is at least
    SIGMA, and by (1 - (s/SIGMA)^2) DAMPING^2 below, which grows as s shrinks
    (Chiaverini, Siciliano and Egeland 1994; in the directions that are lost only, as
    in Maciejewski and Klein 1988). So away from singularities the hand follows exactly,
    near one it gives up what would cost most, and nowhere do the joints' speeds exceed
    sqrt(1/(2 DAMPING)^2 + 1/SIGMA^2) times the size of v, positions counted in LENGTH.
    The joints' speeds change by JOINT_ACCEL at most, all by the same share. They begin
    with the Q^_CMD of a predecessor, else with X^_DES alone, so that no goal makes them
    jump. Where GAIN times their speeds is more than JOINT_ACCEL, the
    hand passes its goal and comes back.
    While damping takes at least SHORT from the hand's velocity, as before a goal out of
    reach, a warning says so: once, until it takes less than half of that. A goal that
    is no pose stops the joints.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x_des: A[Matrix, InVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v_des: A[Vector, InVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "measured pose, [R p], p in m")]
    jacobian: A[
        Matrix, InVar("J_MEZ", "6,ndof", "mixed", "m/rad in three rows, then rad/rad")
    ]
    qd: A[Vector, OutVar("Q^_CMD", "ndof", "rad/s", "commanded joint velocity")]

    def init(self) -> None:
        self._told = WarnOnce(self.task)
        self._take_scale()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_scale()

    def on(self) -> None:
        rest(self.task, self.qd)
        self._told.clear()
        if not self._has_goal():
            self.qd[:] = 0.0
        elif not self.qd.any():  # who integrates Q^_CMD is turned on next
            self.qd[:] = self._solve(self._shortened(self.v_des.copy()))

    def cycle(self, dt: float) -> None:
        if not self._has_goal():
            self.qd[:] = 0.0
            return
        gain = min(self.params.gain, MOST_GAIN / dt)
        wish = gain * difference(self.x_des, self.x) + self.v_des
        change = self._solve(self._shortened(wish)) - self.qd
        most, room = float(np.abs(change).max()), self.params.joint_accel * dt
        if most > room:
            change *= room / most
        self.qd += change

    def off(self) -> None:
        rest(self.task, self.qd)

    def _has_goal(self) -> bool:
        """Return whether the goal is a pose, and report once if it is none."""
        if why := fault_of_pose(self.x_des):
            self._told.warn("goal", f"X_DES is not a pose: {why}; the joints stop")
            return False
        self._told.clear("goal")
        return True

    def _shortened(self, wish: Vector) -> Vector:
        """Return the hand's velocity, [6], within its limits."""
        shorten(wish[:3], self.params.linear)
        shorten(wish[3:], self.params.angular)
        return wish

    def _solve(self, wish: Vector) -> Vector:
        """Return the joint velocities (rad/s) for a hand velocity, [6]."""
        u, s, v = np.linalg.svd(
            self._scale[:, None] * self.jacobian, full_matrices=False
        )
        left = np.minimum(s / self.params.sigma, 1.0)
        square = (1.0 - left * left) * self.params.damping**2
        share = s / (s * s + square)  # s is zero only where the square is not
        along = u.T @ (self._scale * wish)
        if left[-1] < 1.0:
            self._watch(u @ ((1.0 - s * share) * along), float(s[-1]))
        else:
            self._told.clear("reach")
        joints: Vector = v.T @ (share * along)
        return joints

    def _watch(self, missing: Vector, value: float) -> None:
        """Report once what damping takes from the hand's velocity, in rad/s."""
        k = self.params
        speed = k.length * float(np.abs(missing).max())
        if speed < 0.5 * k.short:
            self._told.clear("reach")
        elif speed >= k.short:
            self._told.warn(
                "reach",
                f"the hand cannot follow X_DES, {speed:.2g} m/s are missing: the arm "
                f"is stretched or singular there, with a singular value of {value:.2g} "
                f"in J_MEZ, damped below {k.sigma:g}",
            )

    def _take_scale(self) -> None:
        self._scale = scale(self.params.length)
