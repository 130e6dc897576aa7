"""Joints and base of a robot in MuJoCo's memory.

The arrays of MuJoCo's data stay where they are, so both hold views of them: an access
to an array of the data makes a new one, which takes longer than to read it.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

class JointMemory:
    """The last joints in MuJoCo's memory, in another order, and limits of torques.

    Args:
        data: MuJoCo's data.
        order: Which of these joints is the first one, and so on, [n].
        bounds: Smallest and largest torque of each joint, [n] and [n].
        q: Where `read` writes the positions, [n].
        qd: Where it writes the velocities, [n].
        torque: Where `command` writes the torques that act, [n].

    Raises:
        ValueError: The sizes differ, or a joint has no place in the order.
    """

    def __init__(
        self,
        data: Any,  # noqa: ANN401 - it has no stubs
        order: NDArray[np.intp],
        bounds: tuple[Floats, Floats],
        q: Floats,
        qd: Floats,
        torque: Floats,
    ) -> None: ...
    def read(self, limit: float) -> int:
        """Read positions and velocities of the joints.

        Returns:
            Which element of MuJoCo's velocity is not within a limit, as no NaN is; -1
            if all are.
        """

    def command(self, wish: Floats) -> None:
        """Let torques act at the joints, within their limits.

        Raises:
            ValueError: It is not one for each joint.
        """

class BaseMemory:
    """The base of a robot in MuJoCo's memory, which moves freely and comes first.

    Args:
        data: MuJoCo's data.
        body: The number of the base.
    """

    def __init__(self, data: Any, body: int) -> None: ...  # noqa: ANN401 - as above
    def read(self, pose: Floats, velocity: Floats) -> None:
        """Read pose and velocity of the base.

        Args:
            pose: Where [R p] is written, [3, 4], p in m.
            velocity: Where m/s of the origin and rad/s are, in the axes of the world.

        Raises:
            ValueError: A size is another one.
        """
