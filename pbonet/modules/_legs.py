"""Checks for robots on legs: of their measured state, and of their feet."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pbonet.errors import ParameterError
from pbonet.io import all_finite, fault_of_pose

from ._dh import fault_of_wrench

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet import Matrix, Vector
    from pbonet.io import RobotModel


def fault_of_joints(name: str, value: Vector, joints: Sequence[str]) -> str:
    """Return which joint's value is no number, as a sentence; empty if all are.

    Args:
        name: The variable.
        value: Its value.
        joints: Names of the joints.
    """
    if all_finite(value):
        return ""
    return f"{name} of joint {joints[int(np.argmin(np.isfinite(value)))]} is not finite"


def fault_of_base(pose: Matrix, velocity: Vector) -> str:
    """Return what is wrong with the measured motion of the base; empty if nothing."""
    if why := fault_of_pose(pose):
        return f"X_MEZ of the base is not a pose: {why}"
    return fault_of_wrench("X^_MEZ of the base", velocity)


def must_have_feet(model: RobotModel, feet: Sequence[str], n: int, port: str) -> None:
    """Check the frames of the feet.

    Args:
        model: The robot.
        feet: Names of the frames.
        n: How many rows the port has.
        port: The port with a row for each foot.

    Raises:
        ParameterError: One is not there or named twice, or their number is another.
    """
    for name in feet:
        model.frame(name)
    if len(feet) != n or len(set(feet)) != n:
        raise ParameterError(
            f"FEET does not name a foot for each row of {port}",
            where=str(model.path),
            expected=f"{n} different frames",
            got=f"{len(feet)}: {' '.join(feet)}",
            remedy=f"name them all once, or give {port} as many rows",
        )
