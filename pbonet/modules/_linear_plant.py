"""A linear plant that is sampled, and the gain that is best for it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import ParameterError
from pbonet.io import from_extra

from ._ode import propagator
from ._values import grid, spread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet import Matrix


class LinearPlant:
    """The plant z' = A z + B u, with u held between two cycles, and weights of z and u.

    Args:
        a: A, row by row.
        b: B, row by row.
        q: Weight of each state, or one for all.
        r: Weight of each command, or one for all.
        n: States.
        m: Commands.
        dt: Seconds of a cycle.

    Attributes:
        a: The state's part in the next state, [n, n].
        b: The command's part in the next state, [n, m].
        q: Weights of the state, [n, n].
        r: Weights of the command, [m, m].
        cost: z' COST z is the least sum of z' Q z + u' R u from z on, [n, n].
        gain: u = -GAIN z attains it, [m, n].

    Raises:
        ParameterError: A parameter has a wrong number of values, or no gain exists.
        DeviceError: scipy is not installed.
    """

    def __init__(
        self,
        *,
        a: Sequence[float],
        b: Sequence[float],
        q: Sequence[float],
        r: Sequence[float],
        n: int,
        m: int,
        dt: float,
    ) -> None:
        with from_extra("design", "the gain of a linear quadratic controller"):
            linalg: Any = import_module("scipy.linalg")
        both = np.zeros((n + m, n + m))
        both[:n, :n], both[:n, n:] = grid(a, n, n, "a"), grid(b, n, m, "b")
        step = propagator(both, dt)
        self.a: Matrix = step[:n, :n].copy()
        self.b: Matrix = step[:n, n:].copy()
        self.q: Matrix = np.diag(spread(q, n, "q"))
        self.r: Matrix = np.diag(spread(r, m, "r"))
        try:
            cost: Matrix = linalg.solve_discrete_are(self.a, self.b, self.q, self.r)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ParameterError(
                "no gain stabilizes this plant",
                expected="A and B that can be stabilized, and a weight on each state "
                "that does not settle by itself",
                got=str(error),
                remedy="check A, B and Q",
            ) from None
        self.cost = cost
        of_command = self.b.T @ cost
        gain = np.linalg.solve(self.r + of_command @ self.b, of_command @ self.a)
        self.gain: Matrix = np.asarray(gain, dtype=np.float64)
