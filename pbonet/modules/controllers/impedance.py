"""Cartesian impedance control of any robot."""

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
from pbonet.modules._dh import shorten
from pbonet.modules._values import PerElement, spread
from pbonet.modules.controllers._takeover import Takeover


class Spring(Params):
    """The spring and damper between hand and goal, and what they may pull."""

    stiffness: A[PerElement, param("mixed", "N/m of x y z, N*m/rad of turns", ge=0)]
    damping: A[PerElement, param("mixed", "N*s/m of x y z, N*m*s/rad of turns", ge=0)]
    limit: A[PerElement, param("N*m", "largest torque of each joint", gt=0)]
    force: A[float, param("N", "largest force of the spring", gt=0)] = 100.0
    moment: A[float, param("N*m", "largest moment of the spring", gt=0)] = 20.0
    joints: A[float, param("N*m*s/rad", "damping of the joints themselves", ge=0)] = 0.0
    fade: A[float, param("s", "time until T_REF is what the law says", gt=0)] = 0.1


class Impedance(PortBasedObject[Spring], module_class="controller"):
    """tau = J' (K (x_des - x) + D (xd_des - J qd)) - joints qd + t_grav.

    The hand behaves as if a spring and a damper held it at the goal (Hogan 1985); what
    touches it feels them, and no inertia is shaped. Stiffness and damping are along and
    about the axes of the base. The torque stays within +-LIMIT. FORCE and MOMENT bound
    the spring, so that a goal far away pulls no harder. An arm with more joints than
    the hand has directions needs JOINTS, which damps its own motion. T_GRAV comes from
    `grav_comp` or `gravity`, X_MEZ and J_MEZ from `forward_kin` or `fk_jac`. When the
    module is turned on it goes on from the T_REF that is there, and the distance fades.
    While X_DES is no pose, only dampers and T_GRAV act.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x_des: A[Matrix, InVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v_des: A[Vector, InVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "measured pose, [R p], p in m")]
    jacobian: A[
        Matrix, InVar("J_MEZ", "6,ndof", "mixed", "m/rad in three rows, then rad/rad")
    ]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    t_grav: A[Vector, InVar("T_GRAV", "ndof", "N*m", "torque that balances gravity")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "commanded torque")]

    def init(self) -> None:
        self._takeover = Takeover(self.tau)
        self._take_spring()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_spring()

    def on(self) -> None:
        self._lost = False
        self._takeover.begin()

    def cycle(self, dt: float) -> None:
        wrench = self._pull() - self._damping * (self.jacobian @ self.qd)
        law = self.jacobian.T @ wrench - self.params.joints * self.qd + self.t_grav
        self._takeover.apply(law, dt, self.params.fade)

    def _pull(self) -> Vector:
        """Return the wrench of the spring and of the goal's motion (N, N*m)."""
        why = fault_of_pose(self.x_des)
        if why and not self._lost:
            self.task.warn(f"X_DES is not a pose: {why}; nothing draws the hand")
        if bool(why) != self._lost:
            self._lost = bool(why)
            self._takeover.begin()  # neither losing the spring nor finding it is a jump
        if why:
            return np.zeros(6)
        pull = self._stiffness * difference(self.x_des, self.x)
        shorten(pull[:3], self.params.force)
        shorten(pull[3:], self.params.moment)
        pull += self._damping * self.v_des
        return pull

    def _take_spring(self) -> None:
        k = self.params
        self._stiffness = spread(k.stiffness, 6, "stiffness")
        self._damping = spread(k.damping, 6, "damping")
        limit = spread(k.limit, self.ndof, "limit")
        self._takeover.bound(-limit, limit)
