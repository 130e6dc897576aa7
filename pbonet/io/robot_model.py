"""Rigid-body mathematics of a robot that a URDF file describes, by pinocchio.

The robot stands on a base that does not move, and each of its joints turns or slides
between limits. Joints are in the order in which the file nests them, from the base.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import ParameterError, did_you_mean
from pbonet.outside import note_file

from ._friction import add_damping
from .chain import pinocchio

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


class RobotModel:
    """A robot's frames, Jacobians and torques.

    Args:
        file: The URDF file, as for `find_file`.
        libraries: Folders in which it is looked for.

    Raises:
        ParameterError: There is no such file, it is no URDF, or a joint has no limits.
        DeviceError: pinocchio is not installed.
    """

    def __init__(self, file: str, libraries: Iterable[str | Path] = ()) -> None:
        self._pin: Any = pinocchio()
        self.path = find_file(file, libraries)
        self._model = self._read()
        self._data = self._model.createData()
        self.n = int(self._model.nv)
        self.joints = tuple(str(name) for name in self._model.names)[1:]
        self.lower: Floats = np.array(self._model.lowerPositionLimit)
        self.upper: Floats = np.array(self._model.upperPositionLimit)
        self.velocity: Floats = np.array(self._model.velocityLimit)
        effort = np.array(self._model.effortLimit)
        self.effort: Floats = np.where(effort > 0.0, effort, np.inf)
        """Largest torque (N*m) or force (N) of each joint; infinite if not given."""
        self.damping: Floats = np.array(self._model.damping)
        """Viscous friction of each joint, N*m*s/rad or N*s/m."""
        self._damped = bool(self.damping.any())

    def must_have(self, n: int) -> None:
        """Check the number of joints.

        Raises:
            ParameterError: It is not `n`.
        """
        if n != self.n:
            raise ParameterError(
                "the robot of this file has another number of joints than NDOF says",
                where=str(self.path),
                expected=f"{n} joints",
                got=f"{self.n}: {' '.join(self.joints)}",
                remedy="name the URDF of this robot, with fixed joints for those that "
                "are not controlled",
            )

    def frame(self, name: str) -> int:
        """Return the number of a frame: of a link or a joint.

        Raises:
            ParameterError: There is none of that name.
        """
        known = list(dict.fromkeys(str(one.name) for one in self._model.frames))[1:]
        if name not in known:
            raise ParameterError(
                f"the robot has no frame {name}",
                where=str(self.path),
                expected=" or ".join(known),
                remedy=did_you_mean(name, known) or "name one of these",
            )
        return int(self._model.getFrameId(name))

    def pose(self, q: Floats, frame: int, out: Floats) -> None:
        """Write the pose of a frame, [R p] with p in m, to `out`, [3, 4]."""
        self._pin.forwardKinematics(self._model, self._data, q)
        self._copy_pose(frame, out)

    def jacobian(self, q: Floats, frame: int, pose: Floats, jacobian: Floats) -> None:
        """Write pose and Jacobian of a frame to `pose`, [3, 4], and `jacobian`, [6, n].

        Rows of the Jacobian are the velocity of the frame's origin (m/s) and its rate
        of turn (rad/s) for each rad/s of a joint, both in the axes of the base.
        """
        pin = self._pin
        found = pin.computeFrameJacobian(
            self._model, self._data, q, frame, pin.LOCAL_WORLD_ALIGNED
        )
        jacobian[:] = found.reshape(jacobian.shape)  # that of one joint is no matrix
        self._copy_pose(frame, pose)

    def gravity(self, q: Floats) -> Floats:
        """Return the torques (N*m) that hold the robot still at `q` (rad)."""
        torque: Floats = self._pin.computeGeneralizedGravity(self._model, self._data, q)
        return torque

    def torque(self, q: Floats, qd: Floats, qdd: Floats) -> Floats:
        """Return the torques (N*m) that give the robot the acceleration `qdd`."""
        torque: Floats = self._pin.rnea(self._model, self._data, q, qd, qdd)
        self.add_damping(torque, qd)
        return torque

    def add_damping(self, torque: Floats, qd: Floats) -> None:
        """Add what the viscous friction of the joints takes at the velocities `qd`."""
        if self._damped:
            add_damping(torque, self.damping, qd)

    def _copy_pose(self, frame: int, out: Floats) -> None:
        place = self._pin.updateFramePlacement(self._model, self._data, frame)
        out[:, :3] = place.rotation
        out[:, 3] = place.translation

    def _read(self) -> Any:  # noqa: ANN401 - it has no stubs
        try:
            model = self._pin.buildModelFromUrdf(str(self.path))
        except (ValueError, RuntimeError) as error:
            raise ParameterError(
                "the file is no URDF model of a robot",
                where=str(self.path),
                got=" ".join(str(error).split()),
                remedy="correct it (`check_urdf` says where), or name another file",
            ) from None
        self._check(model)
        return model

    def _check(self, model: Any) -> None:  # noqa: ANN401 - as above
        """Refuse joints of more than one number, or without limits."""
        for index, (name, joint) in enumerate(
            zip(model.names, model.joints, strict=True)
        ):
            if index and (joint.nq, joint.nv) != (1, 1):
                raise ParameterError(
                    f"joint {name} turns without limits, or moves in several ways",
                    where=str(self.path),
                    expected="revolute or prismatic joints with limits",
                    got=str(joint.shortname()),
                    remedy="give it limits and the type revolute, or make it fixed",
                )
        if model.nv == 0:
            raise ParameterError(
                "the robot has no joint",
                where=str(self.path),
                expected="at least one revolute or prismatic joint",
                remedy="name the URDF of a robot that moves",
            )


def find_file(file: str, libraries: Iterable[str | Path] = ()) -> Path:
    """Return the path of a file that a parameter names.

    It is for `init`: the file's hash is recorded, so that a replay names a file that
    has changed since the run.

    Args:
        file: An absolute path, or a path in one of the folders.
        libraries: The folders, as `self.task.libraries` has them; earlier ones win.

    Raises:
        ParameterError: There is no such file.
    """
    folders = [Path(folder) for folder in libraries]
    for path in (
        [Path(file)] if Path(file).is_absolute() else [f / file for f in folders]
    ):
        if path.is_file():
            note_file(file, path)
            return path
    raise ParameterError(
        f'there is no file "{file}"',
        expected=f"an absolute path, or a file in {' or '.join(map(str, folders))}"
        if folders
        else "an absolute path, for no folder of modules is named",
        remedy="put it beside the modules of this system, or correct its name",
    )
