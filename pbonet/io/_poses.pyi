"""Arithmetic of poses, and steps towards them.

A pose is the matrix [R p] of three rows and four columns: orientation and origin (m) of
a frame in the base; where more rows are given they do not count. A turn is an axis
times an angle (rad). Velocities and displacements are (m/s, rad/s) and (m, rad) in the
base's axes. Arrays are of float64.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

def all_finite(*arrays: Floats) -> bool:
    """Return whether no element of some contiguous arrays is NaN or infinite."""

def rotation(turn: Floats) -> Floats:
    """Return the rotation matrix, [3, 3], of a turn, [3] (Rodrigues)."""

def turn_of(rotation: Floats) -> Floats:
    """Return the turn, [3], of at most pi, of a rotation matrix, [3, 3]."""

def difference(wanted: Floats, pose: Floats) -> Floats:
    """Return the displacement, [6], that takes a pose to the wanted one."""

def is_rotation(matrix: Floats) -> bool:
    """Return whether a matrix, [3, 3], is a rotation, to 1e-6."""

def fault_of_pose(pose: Floats) -> str:
    """Return why a matrix is no pose, as the end of a sentence; empty if it is one."""

class FreeMotion:
    """Position and velocity of a robot with a free base, as pinocchio has them.

    Args:
        q: The position, [7 + n], which `set` writes: place, x y z w, joints.
        v: The velocity, [6 + n], in the base's own axes, then the joints'.

    Raises:
        ValueError: The sizes do not belong together.
    """

    def __init__(self, q: Floats, v: Floats) -> None: ...
    def set(self, pose: Floats, velocity: Floats, q: Floats, qd: Floats) -> bool:
        """Set where the robot is and how it moves.

        Args:
            pose: Of the base.
            velocity: Of the base, [6], in the axes of the world.
            q: Joint positions, [n].
            qd: Joint velocities, [n].

        Returns:
            Whether the pose is one, and all numbers are finite.

        Raises:
            ValueError: A size is another one.
        """

class FrameStep:
    """The next step of a frame to its goal.

    Args:
        wanted: The pose to be reached, [3, 4], read at each `aim`.
        velocity: The velocity of that pose, [6], read too; none for one that stands.

    Attributes:
        goal: The pose after the step, [4, 4].
        speed: Of the step, m/s.
        rate: Of the step, rad/s.

    Raises:
        ValueError: The sizes are others.
    """

    goal: Floats
    speed: float
    rate: float

    def __init__(self, wanted: Floats, velocity: Floats | None = None) -> None: ...
    def aim(
        self, pose: Floats, gain: float, linear: float, angular: float, dt: float
    ) -> None:
        """Set `goal`: where the frame is after `dt` with gain * error + velocity.

        Args:
            pose: Where the frame is.
            gain: Of the displacement to the wanted pose, 1/s.
            linear: Largest speed, m/s.
            angular: Largest rate of turn, rad/s.
            dt: Length of the step, seconds.
        """

    def take(self) -> bool:
        """Set `goal` to `wanted`, without a step; return whether that is a pose."""

    def missing(self, pose: Floats, length: float) -> float:
        """Return how far a pose is from `goal`: its largest element, m.

        Args:
            pose: Where the frame is.
            length: Of a radian, m.
        """

class PlaceSteps:
    """The next steps of points to their goals.

    Args:
        wanted: The places to be reached, [n, 3], m, read at each `aim`.

    Attributes:
        places: Where the points are, [n, 3], m.
        goals: Where they are after the step, [n, 3], m.

    Raises:
        ValueError: It is no such array.
    """

    places: Floats
    goals: Floats

    def __init__(self, wanted: Floats) -> None: ...
    def see(self, row: int, pose: Floats) -> None:
        """Take the origin of a pose for the place of a point."""

    def aim(self, gain: float, limit: float, dt: float) -> float:
        """Set `goals`: where the points are after `dt` with gain * error.

        Args:
            gain: Of their errors, 1/s.
            limit: Largest speed, m/s.
            dt: Length of the step, seconds.

        Returns:
            The largest speed without that limit, m/s.
        """

    def farthest(self) -> tuple[float, int]:
        """Return how far the places are from `goals` at most, m, and which one."""

class JointSteps:
    """Takes steps of joints behind a free base, and writes their reference.

    Args:
        q: Joint positions, [n], which `take` changes.
        q_ref: Where it writes them, [n].
        qd_ref: Where it writes their velocities, [n].
        lower: The joints' smallest positions, [n].
        upper: Their largest ones.
        speed: Their largest speeds.

    Attributes:
        room: Largest positions after the next step, and the smallest ones times -1.
        at_accel: Whether its acceleration held a joint back in the last step.

    Raises:
        ValueError: The sizes differ.
    """

    room: Floats
    at_accel: bool

    def __init__(
        self,
        q: Floats,
        q_ref: Floats,
        qd_ref: Floats,
        lower: Floats,
        upper: Floats,
        speed: Floats,
    ) -> None: ...
    def limit(self, accel: float, dt: float) -> bool:
        """Set `room`, so that each joint can stop before its limit.

        Velocities go on from those in `qd_ref`.

        Args:
            accel: How fast a joint's velocity may change, per s^2; may be infinite.
            dt: Length of the step, seconds.

        Returns:
            False: a joint is further beyond a limit than a step takes it.
        """

    def take(self, step: Floats, dt: float) -> None:
        """Take a step of base and joints, [6 + n], in `dt` seconds.

        Raises:
            ValueError: It has another size.
        """
