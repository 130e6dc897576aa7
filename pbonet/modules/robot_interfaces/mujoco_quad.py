"""The robot interface of a legged robot that MuJoCo simulates: torques in, motion out.

A module with these ports, the drives of a real robot, and its estimate of where it is
would replace it without a change anywhere else.
"""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InVar,
    Matrix,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.errors import ParameterError
from pbonet.io import MujocoRobot, all_finite, fault_of_pose
from pbonet.modules._values import PerElement, keep, spread


class Robot(Params):
    """The model of the robot, what its drives do without commands, and a push."""

    model: A[str, param("none", "MJCF file of the robot, in a folder of modules")]
    step: A[float, param("s", "longest step of the simulation", gt=0)] = 1e-3
    hold: A[PerElement, param("N*m/rad", "stiffness in `stable`", gt=0)] = (100.0,)
    damp: A[PerElement, param("N*m*s/rad", "damping in `stable`", ge=0)] = (2.0,)
    slow: A[PerElement, param("rad/s^2", "deceleration in `stable`", gt=0)] = (20.0,)
    push: A[
        tuple[float, float, float],
        param("N", "force on the base, for PUSH_TIME after it is set while ON"),
    ] = (0.0, 0.0, 0.0)
    push_time: A[float, param("s", "how long PUSH acts", ge=0)] = 0.2


class MujocoQuad(PortBasedObject[Robot], module_class="robot interface"):
    """tau = t_ref, within what the joints bear; the rest is what MuJoCo makes of it.

    Any robot whose base moves freely, with any number of legs and joints that turn or
    slide. Joints are in the order of pinocchio; where a branch begins with a fixed
    joint in the URDF file, MODEL must have a body of that joint's name and without a
    joint there, or legs can be exchanged. It begins where the table says that it was
    seen last; while X_MEZ is no pose, its base begins where the file puts it. A torque
    acts from the cycle in which it is read to the next one, as with real drives; T_MEZ
    is what acted until now. Without a torque that is fresh, or while the configuration
    is illegal, each joint slows down by SLOW, and its drive holds it there by HOLD and
    DAMP, beginning with the torque that acted: the robot stays in its posture. While
    the task is OFF no time passes for the robot. `set` of PUSH pushes its base, along
    the axes of the world; `on` does not repeat that.
    """

    ndof: A[int, OutConst("NDOF", "1", "none", "degrees of freedom, without the base")]
    t_ref: A[
        Vector,
        InVar("T_REF", "ndof", "N*m", "torque", max_age=0.05, stale="stable"),
    ]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p]", new=True)]
    v: A[
        Vector,
        OutVar("X^_MEZ", "6", "mixed", "its velocity, m/s and rad/s", new=True),
    ]
    q: A[Vector, OutVar("Q_MEZ", "ndof", "rad", "measured joint position", new=True)]
    qd: A[
        Vector, OutVar("Q^_MEZ", "ndof", "rad/s", "measured joint velocity", new=True)
    ]
    tau: A[Vector, OutVar("T_MEZ", "ndof", "N*m", "torque that acted", new=True)]

    def init(self) -> None:
        k = self.params
        self._robot = robot = MujocoRobot(
            k.model, self.task.libraries, step=k.step, floats=True
        )
        n = robot.n
        if len(self.q) != n:
            raise ParameterError(
                "the robot has another number of joints than Q_MEZ has elements",
                where=str(robot.path),
                expected=f"{len(self.q)} joints",
                got=f"{n}: {' '.join(robot.joints)}",
                remedy=f"set NELEM of the variables to {n}, or name another model",
            )
        self.ndof = n
        self._r, self._v = np.zeros(n), np.zeros(n)
        self._pushing = 0.0
        self._take_drives()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"model", "step"})
        self._take_drives()
        if name == "push":
            self._pushing = self.params.push_time

    def on(self) -> None:
        # A simulated robot stands where the table says that it was seen last; that of a
        # real one would be overwritten here by what its sensors say.
        robot = self._robot
        robot.place(self.q, self.qd)
        if not fault_of_pose(self.x):
            robot.place_base(self.x, self.v)
        robot.sense_base(self.x, self.v)
        self._pushing = 0.0
        robot.command(self.tau)
        self._follow()
        self._stops = True
        self._hold()

    def cycle(self, dt: float) -> None:
        if not all_finite(self.t_ref):
            joint = self._robot.joints[int(np.argmin(np.isfinite(self.t_ref)))]
            self.task.fail(f"T_REF of joint {joint} is not finite; the brakes are on")
            return
        self._sense(dt)
        self._robot.command(self.t_ref)
        self._stops = False

    def stable(self, dt: float) -> None:
        """Stop the joints, and hold the posture without inputs."""
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
            self.qd[:], self.v[:] = 0.0, 0.0

    def _sense(self, dt: float) -> None:
        robot = self._robot
        self.tau[:] = robot.torque
        pushed = self._pushing > 0.0
        if pushed:
            self._pushing -= dt
            robot.push(self._push)
        robot.advance(dt)
        if pushed:
            robot.push(self._none)
        self.q[:], self.qd[:] = robot.q, robot.qd
        robot.sense_base(self.x, self.v)

    def _follow(self) -> None:
        """Let `stable` begin where the joints are, and with the torque that acts."""
        robot = self._robot
        self._v[:] = robot.qd
        np.divide(robot.torque, self._stiff, out=self._r)
        self._r += robot.q

    def _hold(self) -> None:
        """Let each drive draw its joint to the point that moves and stops."""
        robot = self._robot
        robot.command(
            self._stiff * (self._r - robot.q) + self._damping * (self._v - robot.qd)
        )

    def _take_drives(self) -> None:
        k, n = self.params, self._robot.n
        self._stiff = spread(k.hold, n, "hold")
        self._damping = spread(k.damp, n, "damp")
        self._slow = spread(k.slow, n, "slow")
        self._push, self._none = np.array(k.push), np.zeros(3)
