"""Inverse kinematics of the PUMA 560 and arms built like it, in closed form."""

from typing import Annotated as A

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
from pbonet.io import fault_of_pose
from pbonet.modules._puma_arm import PumaArm
from pbonet.modules._values import PerElement, spread

AGAIN = 1.5
"""A new warning needs a distance of NEAR times this from the singularity."""


class Posture(Params):
    """Limits for solutions, and the transition to them."""

    lower: A[PerElement, param("rad", "smallest angle of each joint")]
    upper: A[PerElement, param("rad", "largest angle of each joint")]
    near: A[
        float, param("none", "warn when a singularity is closer than this", ge=0, lt=1)
    ] = 0.1
    fade: A[float, param("s", "time until Q_REF has reached the solution", gt=0)] = 0.5


class PumaInvKin(PortBasedObject[Posture], module_class="kinematics"):
    """q_ref = the joint angles that take the hand to the pose x, nearest to the last.

    When it is turned on, Q_REF moves from where it stands to the solution within FADE.
    A pose without a solution leaves Q_REF where it is, with a warning; so does one
    that is no pose. A warning also names a singularity that is near: there, small
    motions of the hand take large ones of the joints, and this module asks for them.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    dh: A[Matrix, InConst("DH", "ndof,4", "mixed", "rows of theta, d, a, alpha")]
    x: A[Matrix, InVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    q_ref: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]

    def init(self) -> None:
        self._take_arm()

    def reinit(self) -> None:
        self._take_arm()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_arm()

    def on(self) -> None:
        self._solution = self.q_ref.copy()
        self._holds = True
        self._told = ""
        self._close: set[str] = set()

    def cycle(self, dt: float) -> None:
        if why := fault_of_pose(self.x):
            self._hold("pose", f"X_DES is not a pose: {why}")
            return
        found, why = self._arm.solve(self.x, self._solution)
        if found is None:
            self._hold(why.partition(":")[0], f"no solution, {why}")
            return
        if self._holds:
            self._holds, self._time = False, 0.0
            self._offset = self.q_ref - found
            self._told = ""
        self._time += dt
        self._solution = found
        self.q_ref[:] = found + self._left() * self._offset
        self._watch()

    def _left(self) -> float:
        """Return the remaining share of the offset from the solution."""
        x = min(self._time / self.params.fade, 1.0)
        return 1.0 - x * x * (3.0 - 2.0 * x)

    def _hold(self, kind: str, text: str) -> None:
        """Leave Q_REF unchanged, and report the reason once."""
        self._holds = True
        if kind != self._told:
            self._told = kind
            self.task.warn(f"{text}; Q_REF does not change")

    def _watch(self) -> None:
        """Report a nearby singularity once."""
        near = self.params.near
        for name, distance in self._arm.singular(self._solution).items():
            if distance < near and name not in self._close:
                self._close.add(name)
                self.task.warn(
                    f"the arm comes near its {name} singularity: {distance:.3f} of 1"
                )
            elif distance > AGAIN * near:
                self._close.discard(name)

    def _take_arm(self) -> None:
        k = self.params
        lower, upper = (
            spread(k.lower, self.ndof, "lower"),
            spread(k.upper, self.ndof, "upper"),
        )
        if (lower >= upper).any():
            raise ParameterError(
                "the joint limits leave a joint no room",
                expected="LOWER below UPPER",
                got=f"LOWER {k.lower}, UPPER {k.upper}",
                remedy="exchange the two, or widen them",
            )
        self._arm = PumaArm(self.dh, lower, upper)
