"""Steps of an arm with friction and end stops."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]

def add_damping(torque: Floats, damping: Floats, qd: Floats) -> None:
    """Add what viscous friction takes to the torques of joints, [n].

    Args:
        torque: Changed.
        damping: N*m*s/rad or N*s/m.
        qd: Velocities, rad/s or m/s.

    Raises:
        ValueError: The sizes differ.
    """

def solve_with_friction(
    matrix: Floats,
    push: Floats,
    bounds: Sequence[tuple[float, float]],
    guess: Floats,
    all_at_once: int = 10,
) -> Floats:
    """Return the velocity v with matrix v + f = push and Coulomb friction f.

    With bounds (low, high), f[i] = high where v[i] > 0, low where v[i] < 0, and between
    them where v[i] is 0. For a symmetric positive definite matrix there is exactly one
    such v. Signs are guessed and corrected all at once, which usually takes one or two
    rounds; if that cycles, only the first wrong sign is corrected, which ends for
    certain (the principal pivoting of Judice and Pires 1994).

    Args:
        matrix: Symmetric positive definite, n by n, n at most 32.
        push: n momenta.
        bounds: n times the bounds of the friction: one at most 0, or minus infinity
            for a stop, and one at least 0, or infinity for a stop.
        guess: A velocity whose signs are likely right.
        all_at_once: Rounds in which every wrong sign is corrected.

    Raises:
        ValueError: There are more joints, or the sizes differ.
    """

class FrictionStep:
    """The steps of one arm.

    Args:
        q: Joint angles, rad; changed by `advance`, as is `qd`.
        qd: Joint velocities, rad/s.
        torque: Torques of the motors, N*m.
        viscous: Viscous friction, N*m*s/rad.
        down: Coulomb friction against movement down, N*m, at least 0.
        up: The same upwards.
        lower: End stops, rad.
        upper: The other end stops.

    Raises:
        ValueError: There are more than 32 joints, or the sizes differ.
    """

    def __init__(
        self,
        q: Floats,
        qd: Floats,
        torque: Floats,
        *,
        viscous: ArrayLike,
        down: ArrayLike,
        up: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
    ) -> None: ...
    def advance(self, mass: Floats, bias: Floats, h: float) -> None:
        """Take a step: M v' + h (D v' + f) = M v + h (torque - bias), q' = q + h v'.

        The friction f lies between its bounds, and is at one of them while v' is not
        zero. An end stop is a bound without end.

        Args:
            mass: The mass matrix M, kg*m^2, n by n.
            bias: Gravity, centrifugal and Coriolis torques, N*m.
            h: The length of the step, seconds.

        Raises:
            ValueError: The sizes are not those of the arm.
        """
