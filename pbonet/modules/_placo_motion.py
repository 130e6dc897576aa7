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
        qd_ref: Where their velocities are written.

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
        self.solver.enable_joint_limits(True)  # noqa: FBT003 - placo's
        self.solver.enable_velocity_limits(True)  # noqa: FBT003
        self.solver.add_regularization_task(damping)
        self._all = np.array(self.robot.state.q)
        self.q: Vector = self._all[BASE:]
        self._steps, self._qd_ref = JointSteps(self.q, q_ref, qd_ref), qd_ref
        self._dt = 0.0

    def show(self) -> None:
        """Tell placo where the joints are, and leave its base."""
        robot = self.robot
        if self._floats:
            self._all[:BASE] = robot.state.q[:BASE]
        robot.state.q = self._all
        robot.update_kinematics()

    def step(self, dt: float) -> bool:
        """Move for `dt` seconds as the tasks say, and write the references.

        The base moves in placo, and `q` here. False: no motion keeps the limits, and
        nothing moved.
        """
        if dt != self._dt:
            self._dt = self.solver.dt = dt
        try:
            step = self.solver.solve(True)  # noqa: FBT003 - placo's
        except RuntimeError:
            return False
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
