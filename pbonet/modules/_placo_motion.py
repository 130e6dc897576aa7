"""Inverse kinematics in small steps within the limits of the joints, by placo."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.io import JointSteps, from_extra

if TYPE_CHECKING:
    from pbonet import Vector
    from pbonet.io import RobotModel

BASE = 7
"""Elements of placo's position before the joints: those of a base that could float."""
AT_LIMIT = 1e-6
"""rad; a joint that is no further from a limit stands at it."""
NEARLY = 0.999
"""The share of a joint's largest speed that counts as that speed."""
SAME = 1e-3
"""Weights that differ by this share of them count as the same."""
STIFFEN = 4.0
"""Weight of the joints' own motion for each radian that the last step missed.

Where frames cannot follow, as in an arm that is stretched out, the program otherwise
asks for other directions in each cycle: its linear model does not hold for so large an
error (Sugihara 2011, "Solvability-unconcerned inverse kinematics by the
Levenberg-Marquardt method").
"""


def placo_robot(model: RobotModel, purpose: str) -> tuple[Any, Any]:
    """Return placo, and its robot of the same file.

    Raises:
        DeviceError: placo is not installed.
    """
    with from_extra("placo", purpose):
        placo: Any = import_module("placo")
    return placo, placo.RobotWrapper(str(model.path), placo.Flags.ignore_collisions)


class PlacoMotion:
    """A robot that placo's quadratic program moves, step by step.

    Args:
        model: The robot.
        damping: Weight of the joints' own motion.
        floats: Whether its base moves, too.
        q_ref: Where the joints' positions are written.
        qd_ref: Where their velocities are written, and from which they go on.

    Attributes:
        robot: That of placo, where tasks find its frames.
        solver: That of placo, to which tasks are given.
        q: The joints' positions.
    """

    def __init__(
        self,
        model: RobotModel,
        damping: float,
        *,
        floats: bool,
        q_ref: Vector,
        qd_ref: Vector,
    ) -> None:
        self._model, self._floats = model, floats
        placo, self.robot = placo_robot(model, "inverse kinematics within limits")
        self.solver: Any = placo.KinematicsSolver(self.robot)
        self.solver.mask_fbase(not floats)
        self._own: Any = self.solver.add_regularization_task(1.0)
        self._damping, self._weight = damping, 1.0
        self._all = np.array(self.robot.state.q)
        self.q: Vector = self._all[BASE:]
        self._qd_ref, self._dt, self._missing = qd_ref, 0.0, 0.0
        self._steps = JointSteps(
            self.q, q_ref, qd_ref, model.lower, model.upper, model.velocity
        )
        sides = np.hstack((np.zeros((len(self.q), BASE)), np.eye(len(self.q))))
        self._room: Any = self.solver.add_joint_space_half_spaces_constraint(
            np.vstack((sides, -sides)), self._steps.room
        )
        self._room.configure("limits", "hard")

    @property
    def speeds_up(self) -> bool:
        """Whether its acceleration held a joint back in the last step."""
        return self._steps.at_accel

    def show(self) -> None:
        """Tell placo where the joints are, and leave its base."""
        robot = self.robot
        if self._floats:
            self._all[:BASE] = robot.state.q[:BASE]
        robot.state.q = self._all
        robot.update_kinematics()

    def missed(self, angle: float) -> None:
        """Take note how far the frames are from where the last step was to take them.

        Args:
            angle: The largest of them; lengths count as much as angles, rad.
        """
        self._missing = angle

    def step(self, dt: float, accel: float) -> bool:
        """Move for `dt` seconds as the tasks say, and write the references.

        The base moves in placo, and `q` here. False: no motion keeps the limits, and
        nothing moved.

        Args:
            dt: Seconds.
            accel: How fast the velocity of a joint may change, rad/s^2.
        """
        if dt != self._dt:
            self._dt = self.solver.dt = dt
        if not self._steps.limit(accel, dt):
            return False
        self._room.b = self._steps.room
        weight = self._damping + STIFFEN * self._missing
        if abs(weight - self._weight) > SAME * self._weight:
            self._weight = weight
            self._own.configure("own", "soft", weight)
        try:
            step = self.solver.solve(True)  # noqa: FBT003 - placo's
        except RuntimeError:
            return False
        self._missing = 0.0
        self._steps.take(step, dt)
        return True

    def stopped(self) -> str:
        """Return which joints are at or beyond a limit, as the end of a sentence."""
        model, rates = self._model, self._qd_ref
        near = np.minimum(self.q - model.lower, model.upper - self.q) < AT_LIMIT
        fast = np.abs(rates) > NEARLY * model.velocity
        told = [
            f"{name} is at its limit, {q:.4f} rad of {low:.4f} to {high:.4f}"
            if stands
            else f"{name} is at its largest speed"
            for name, q, low, high, stands, runs in zip(
                model.joints, self.q, model.lower, model.upper, near, fast, strict=True
            )
            if stands or runs
        ]
        return ", ".join(told) or "the robot is stretched or singular there"
