"""The robot interface of an arm that MuJoCo simulates: torques in, motion out.

A module with these ports and a real arm's drives in place of `MujocoRobot` would
replace it without a change anywhere else.
"""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, OutConst, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import MujocoRobot, all_finite
from pbonet.modules._values import PerElement, keep, spread

STIFFNESS, DAMPING = 400.0, 40.0
"""1/s^2 and 1/s, critically damped: how `stable` draws the arm to where it stops."""


class Arm(Params):
    """The model of the arm, and what the interface does without commands."""

    model: A[str, param("none", "MJCF or URDF file of the arm, in a folder of modules")]
    step: A[float, param("s", "longest step of the simulation", gt=0)] = 1e-3
    slow: A[PerElement, param("rad/s^2", "deceleration in `stable`", gt=0)] = (4.0,)


class MujocoArm(PortBasedObject[Arm], module_class="robot interface"):
    """tau = t_ref, within what the arm bears; q and qd are what MuJoCo makes of it.

    Any arm that stands on its base and whose joints turn or slide. They are in the
    order of pinocchio, unless branches begin with fixed joints: those need an MJCF file
    with a body of that joint's name and without a joint there. A torque acts from
    the cycle in which it is read to the next one, as with real drives. Without a torque
    that is fresh, or while the configuration is illegal, the arm slows down by SLOW,
    stops, and is held where it stands by its own model of the dynamics. While the
    task is OFF the brakes are on: no time passes for the arm.
    """

    ndof: A[int, OutConst("NDOF", "1", "none", "degrees of freedom")]
    t_ref: A[
        Vector,
        InVar("T_REF", "ndof", "N*m", "torque", max_age=0.05, stale="stable"),
    ]
    q: A[Vector, OutVar("Q_MEZ", "ndof", "rad", "measured joint position", new=True)]
    qd: A[
        Vector, OutVar("Q^_MEZ", "ndof", "rad/s", "measured joint velocity", new=True)
    ]

    def init(self) -> None:
        k = self.params
        self._arm = MujocoRobot(k.model, self.task.libraries, step=k.step)
        n = self._arm.n
        if len(self.q) != n:
            raise ParameterError(
                "the arm has another number of joints than Q_MEZ has elements",
                where=str(self._arm.path),
                expected=f"{len(self.q)} joints",
                got=f"{n}: {' '.join(self._arm.joints)}",
                remedy=f"set NELEM of the variables to {n}, or name another model",
            )
        self.ndof = n
        self._r, self._v = np.zeros(n), np.zeros(n)
        self._take_slow()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"model", "step"})
        self._take_slow()

    def on(self) -> None:
        # A simulated arm stands where the table says that it was seen last; that of a
        # real one would be overwritten here by what its encoders say.
        self._arm.place(self.q, self.qd)
        self._follow()
        self._stops = True
        self._hold()

    def cycle(self, dt: float) -> None:
        if not all_finite(self.t_ref):
            joint = self._arm.joints[int(np.argmin(np.isfinite(self.t_ref)))]
            self.task.fail(f"T_REF of joint {joint} is not finite; the brakes are on")
            return
        self._sense(dt)
        self._arm.command(self.t_ref)
        self._stops = False

    def stable(self, dt: float) -> None:
        """Slow down, stop and stay, by the arm's own model and no inputs."""
        if not self._stops:
            self._follow()
            self._stops = True
        self._sense(dt)
        step = self._slow * dt
        self._v -= self._v.clip(-step, step)
        self._r += self._v * dt
        self._hold()

    def off(self) -> None:
        if not self.task.handover:
            self.qd[:] = 0.0

    def _sense(self, dt: float) -> None:
        self._arm.advance(dt)
        self.q[:] = self._arm.q
        self.qd[:] = self._arm.qd

    def _follow(self) -> None:
        """Let `stable` begin where the arm is."""
        self._r[:], self._v[:] = self._arm.q, self._arm.qd

    def _hold(self) -> None:
        """Draw the arm to the point that moves and stops."""
        wish = STIFFNESS * (self._r - self._arm.q) + DAMPING * (self._v - self._arm.qd)
        self._arm.command(self._arm.torque_for(wish))

    def _take_slow(self) -> None:
        self._slow = spread(self.params.slow, self._arm.n, "slow")
