"""Rigid-body mathematics of a robot whose base moves freely, by pinocchio.

A URDF file describes it, whose root link is the base. Its joints turn or slide between
limits, and are in the order in which the file nests them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ._poses import FreeMotion
from .chain import pinocchio
from .robot_model import RobotModel

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

RATES = 6
"""Elements of the velocity before the joints', in the base's own axes."""


class FloatingModel:
    """A robot's momenta and the forces at its joints, while its base moves.

    Args:
        file: The URDF file, as for `find_file`.
        libraries: Folders in which it is looked for.

    Attributes:
        joints: The robot without its base's motion: names, limits, friction.
        q: The position, base first.
        v: The velocity, base first.

    Raises:
        ParameterError: As for `RobotModel`.
        DeviceError: pinocchio is not installed.
    """

    def __init__(self, file: str, libraries: Iterable[str | Path] = ()) -> None:
        self._pin: Any = pinocchio()
        self.joints = RobotModel(file, libraries)
        path = str(self.joints.path)
        self._model = self._pin.buildModelFromUrdf(
            path, self._pin.JointModelFreeFlyer()
        )
        self._data = self._model.createData()
        self.q: Floats = np.array(self._pin.neutral(self._model))
        self.v: Floats = np.zeros(int(self._model.nv))
        self._motion = FreeMotion(self.q, self.v)
        self._still = np.zeros(self._model.nv)
        self.mass = float(self._pin.computeTotalMass(self._model))
        """Of the whole robot, kg."""

    def frame(self, name: str) -> int:
        """Return the number of a frame: of a link or a joint.

        Raises:
            ParameterError: There is none of that name.
        """
        self.joints.frame(name)
        return int(self._model.getFrameId(name))

    def move(self, pose: Floats, velocity: Floats, q: Floats, qd: Floats) -> bool:
        """Set where the robot is and how it moves.

        Args:
            pose: Of the base, [R p], p in m.
            velocity: Of the base's origin, m/s, and rad/s, in the axes of the world.
            q: Joint positions.
            qd: Joint velocities.

        Returns:
            Whether the pose is one, and all numbers are finite; if not, nothing can be
            computed until the next call.
        """
        return self._motion.set(pose, velocity, q, qd)

    def momentum(self) -> tuple[Floats, Floats]:
        """Return the generalized momenta of the joints, N*m*s, and their drift, N*m.

        The momenta are M v. The drift, C^T v - g - d qd, is what changes them beside
        the torques and forces from outside: C v are the torques of velocity, g those of
        gravity, d viscous friction.
        """
        pin, model, data = self._pin, self._model, self._data
        weight = np.array(pin.computeGeneralizedGravity(model, data, self.q))
        moved = pin.rnea(model, data, self.q, self._still, self.v)
        momentum: Floats = moved[RATES:] - weight[RATES:]
        found = pin.computeCoriolisMatrix(model, data, self.q, self.v).T @ self.v
        found -= weight
        drift: Floats = found[RATES:] - self.joints.damping * self.v[RATES:]
        return momentum, drift

    def centroidal(self) -> tuple[Floats, Floats]:
        """Return the centre of mass, m, and the momenta of the whole robot.

        The momenta are the linear one, N*s, and the one about the centre of mass,
        N*m*s, in the axes of the world.
        """
        pin, model, data = self._pin, self._model, self._data
        momenta: Floats = pin.computeCentroidalMomentum(
            model, data, self.q, self.v
        ).vector
        return data.com[0], momenta

    def levers(self, frames: Iterable[int], out: Floats) -> None:
        """Write how forces at the origins of frames act at the joints, [n, 3 frames].

        Forces are in the axes of the world, frame by frame.
        """
        pin, model, data = self._pin, self._model, self._data
        for k, frame in enumerate(frames):
            found = pin.computeFrameJacobian(
                model, data, self.q, frame, pin.LOCAL_WORLD_ALIGNED
            )
            out[:, 3 * k : 3 * k + 3] = found[:3, RATES:].T
