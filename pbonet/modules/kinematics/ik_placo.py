"""Inverse kinematics within the limits of the joints, by placo."""

from importlib import import_module
from math import isfinite
from typing import Annotated as A, Any

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
from pbonet.io import RobotModel, from_extra
from pbonet.modules._dh import displacement, fault_of, rotation_by, shortened
from pbonet.modules._values import keep

BASE = 7
"""Elements of placo's position before the joints: those of a base that could float."""
RATES = 6
"""The same of its velocity."""
AT_LIMIT = 1e-6
"""rad; a joint that is no further from a limit stands at it."""
NEARLY = 0.999
"""The share of a joint's largest speed that counts as that speed."""


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
        self._told = ""
        self._aimed = 0.0
        self._q[:] = self.q_ref

    def cycle(self, dt: float) -> None:
        if why := self._fault():
            self._hold("goal", why)
            return
        robot = self._robot
        self._joints[:] = self._q
        robot.state.q = self._all
        robot.update_kinematics()
        x = robot.get_T_world_frame(self._frame)
        if self._aimed:
            self._watch(x)
        step = self._solve(x, dt)
        if step is None:
            self._hold("limits", f"no joint motion keeps the limits: {self._stopped()}")
            return
        self._aimed = dt
        self._q += step
        self.q_ref[:] = self._q
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

    def _solve(self, x: Matrix, dt: float) -> Vector | None:
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
        self._solver.dt = dt
        try:
            step: Vector = self._solver.solve(False)[RATES:]  # noqa: FBT003 - placo's
        except RuntimeError:
            return None
        return step

    def _hold(self, kind: str, text: str) -> None:
        """Leave Q_REF unchanged, and report the reason once."""
        self._aimed = 0.0
        self.qd_ref[:] = 0.0
        self._warn_once(kind, f"{text}; Q_REF does not change")

    def _warn_once(self, kind: str, text: str) -> None:
        if kind != self._told:
            self._told = kind
            self.task.warn(text)

    def _watch(self, x: Matrix) -> None:
        """Report once that the hand is not where the last step should have taken it."""
        u, v, w, a, b, c = displacement(self._goal, x)
        turn = max(abs(a), abs(b), abs(c)) * self.params.length
        missing = max(abs(u), abs(v), abs(w), turn)
        if missing < self.params.short * self._aimed:
            if missing < 0.5 * self.params.short * self._aimed:
                self._told = ""
        elif self._told != "reach":
            self._warn_once(
                "reach",
                f"frame {self.params.frame} cannot follow X_DES: {self._stopped()}",
            )

    def _stopped(self) -> str:
        """Return which joints are at or beyond a limit, as the end of a sentence."""
        robot = self._model
        near = np.minimum(self._q - robot.lower, robot.upper - self._q) < AT_LIMIT
        fast = np.abs(self.qd_ref) > NEARLY * robot.velocity
        told = [
            f"{name} is at its limit, {q:.4f} rad of {low:.4f} to {high:.4f}"
            if stands
            else f"{name} is at its largest speed"
            for name, q, low, high, stands, runs in zip(
                robot.joints, self._q, robot.lower, robot.upper, near, fast, strict=True
            )
            if stands or runs
        ]
        return ", ".join(told) or "the robot is stretched or singular there"

    def _take_robot(self) -> None:
        k = self.params
        self._model = RobotModel(k.urdf, self.task.libraries)
        self._model.must_have(self.ndof)
        self._model.frame(k.frame)  # which must be there
        self._frame = k.frame
        self._q = self.q_ref.copy()
        self._goal = np.eye(4)
        self._goal_pose, self._goal_place = self._goal[:3], self._goal[:3, 3]
        with from_extra("placo", "inverse kinematics within limits"):
            placo: Any = import_module("placo")
        robot = placo.RobotWrapper(str(self._model.path), placo.Flags.ignore_collisions)
        self._all = np.concatenate((np.array(robot.state.q)[:BASE], self._q))
        self._joints = self._all[BASE:]
        solver = placo.KinematicsSolver(robot)
        solver.mask_fbase(True)  # noqa: FBT003 - placo's
        solver.enable_joint_limits(True)  # noqa: FBT003
        solver.enable_velocity_limits(True)  # noqa: FBT003
        solver.add_regularization_task(k.damping)
        self._task = solver.add_frame_task(k.frame, self._goal)
        self._task.configure("hand", "soft", k.length**-2, 1.0)
        self._robot, self._solver = robot, solver
