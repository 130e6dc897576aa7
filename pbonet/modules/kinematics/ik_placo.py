"""Inverse kinematics within the limits of the joints, by placo."""

from math import isfinite
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
from pbonet.io import RobotModel
from pbonet.modules._dh import displacement, fault_of, rotation_by, shortened
from pbonet.modules._placo_motion import PlacoMotion
from pbonet.modules._values import keep
from pbonet.modules._warn_once import WarnOnce


class Pursuit(Params):
    """The robot, and how its hand is taken to the goal."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    frame: A[str, param("none", "link whose frame is the hand")]
    gain: A[float, param("1/s", "gain of the pose error", gt=0)] = 10.0
    linear: A[float, param("m/s", "largest linear speed of the hand", gt=0)] = 0.5
    angular: A[float, param("rad/s", "largest angular speed of the hand", gt=0)] = 1.5
    length: A[float, param("m", "counts as much as one radian", gt=0)] = 0.2
    damping: A[float, param("none", "weight of the joints' own motion", gt=0)] = 1e-4
    short: A[float, param("m/s", "speed that may be missing unreported", gt=0)] = 0.01


class IkPlaco(PortBasedObject[Pursuit], module_class="kinematics"):
    """min (J dq - v dt)^2 + damping dq^2, with v = gain * (x_des - x) + xd_des.

    Solved in each cycle by placo's quadratic program, within the limits of position
    and velocity that the URDF file gives each joint; x and J are those at Q_REF itself,
    so nothing is measured. Rows of positions are counted in LENGTH. Q_REF goes on from
    where it stands when the module is turned on, and a goal far away is approached at
    LINEAR and ANGULAR. A goal that cannot be reached takes the hand as near as the
    joints allow; a warning names those that stand at a limit. What is no pose, or a
    program without a solution, leaves Q_REF where it is.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x_des: A[Matrix, InVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v_des: A[Vector, InVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    q_ref: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]
    qd_ref: A[Vector, OutVar("Q^_REF", "ndof", "rad/s", "reference joint velocity")]

    def init(self) -> None:
        self._take_robot()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "frame", "length", "damping"})

    def on(self) -> None:
        self._told.clear()
        self._aimed = 0.0
        self._motion.q[:] = self.q_ref

    def cycle(self, dt: float) -> None:
        if why := self._fault():
            self._hold("goal", why)
            return
        motion = self._motion
        motion.show()
        x = motion.robot.get_T_world_frame(self._frame)
        if self._aimed:
            self._watch(x)
        step = self._step(x, dt)
        if step is None:
            why = motion.stopped(self.qd_ref)
            self._hold("limits", f"no joint motion keeps the limits: {why}")
            return
        self._aimed = dt
        self.q_ref[:] = motion.q
        np.divide(step, dt, out=self.qd_ref)

    def off(self) -> None:
        if not self.task.handover:
            self.qd_ref[:] = 0.0

    def _fault(self) -> str:
        """Return why the goal is none."""
        if why := fault_of(self.x_des):
            return f"X_DES of frame {self.params.frame} is not a pose: {why}"
        if not all(map(isfinite, self.v_des.tolist())):
            return f"X^_DES of frame {self.params.frame} is not finite"
        return ""

    def _step(self, x: Matrix, dt: float) -> Vector | None:
        """Return the joints' step from a pose of the hand; None if there is none."""
        k = self.params
        u, v, w, a, b, c = map(k.gain.__mul__, displacement(self.x_des, x))
        du, dv, dw, da, db, dc = self.v_des.tolist()
        way = shortened(u + du, v + dv, w + dw, k.linear)
        turn = shortened(a + da, b + db, c + dc, k.angular)
        turned = rotation_by(dt * turn[0], dt * turn[1], dt * turn[2])
        np.matmul(turned, x[:3], out=self._goal_pose)
        self._goal_place[:] = x[:3, 3]
        self._goal_place += (dt * way[0], dt * way[1], dt * way[2])
        self._task.T_world_frame = self._goal
        return self._motion.step(dt)

    def _hold(self, kind: str, text: str) -> None:
        """Leave Q_REF unchanged, and report the reason once."""
        self._aimed = 0.0
        self.qd_ref[:] = 0.0
        self._told.warn(kind, f"{text}; Q_REF does not change")

    def _watch(self, x: Matrix) -> None:
        """Report once that the hand is not where the last step should have taken it."""
        u, v, w, a, b, c = displacement(self._goal, x)
        turn = max(abs(a), abs(b), abs(c)) * self.params.length
        missing = max(abs(u), abs(v), abs(w), turn)
        if missing < 0.5 * self.params.short * self._aimed:
            self._told.clear()
        elif missing >= self.params.short * self._aimed and not self._told.of("reach"):
            why = self._motion.stopped(self.qd_ref)
            self._told.warn(
                "reach", f"frame {self.params.frame} cannot follow X_DES: {why}"
            )

    def _take_robot(self) -> None:
        k = self.params
        self._model = RobotModel(k.urdf, self.task.libraries)
        self._model.must_have(self.ndof)
        self._model.frame(k.frame)  # which must be there
        self._frame = k.frame
        self._goal = np.eye(4)
        self._goal_pose, self._goal_place = self._goal[:3], self._goal[:3, 3]
        self._told = WarnOnce(self.task)
        self._motion = PlacoMotion(self._model, k.damping, floats=False)
        self._task = self._motion.solver.add_frame_task(k.frame, self._goal)
        self._task.configure("hand", "soft", k.length**-2, 1.0)
