"""A Kalman filter of a linear system."""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._values import PerElement, grid, square

MOST = 50
"""Largest number of periods that one cycle predicts."""
UNKNOWN = 1e12
"""Variance above which a state is not known at all; it does not grow further."""


class System(Params):
    """The system in steps of the task's period, and its noise.

    Q, R and P0 are given row by row, or by the diagonal, or by one value for all of it.
    """

    a: A[PerElement, param("none", "state per last state, row by row")]
    b: A[PerElement, param("none", "state per last input U, row by row")]
    c: A[PerElement, param("none", "measurement per state, row by row")]
    q: A[PerElement, param("none", "covariance of what a step adds to the state")]
    r: A[PerElement, param("none", "covariance of the measurement")]
    p0: A[PerElement, param("none", "covariance of the first state")] = (1.0,)


class Kalman(PortBasedObject[System], module_class="sensor"):
    """x = A x + B u, then x += K (z - C x) with the gain K of least variance.

    u is the input of the last cycle. P = A P A' + Q; K = P C' (C P C' + R)^-1; P = (I -
    K C) P (I - K C)' + K R K' (Kalman 1960; Joseph's form). A and B are those of one
    period; a cycle that comes n periods after the last predicts n times. While Z is
    too old by its MAXAGE, or not finite, x is only predicted. It begins with the state
    that is in the table, and the covariance P0.
    """

    z: A[Vector, InVar("Z_MEZ", "nz", "any", "the measurement")]
    u: A[Vector, InVar("U", "nu", "any", "the input of the system")]
    x: A[Vector, OutVar("STATE", "nx", "any", "the estimated state")]

    def init(self) -> None:
        self._take_system()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_system()

    def on(self) -> None:
        self._p = self._p0.copy()
        self._u = self.u.copy()

    def cycle(self, dt: float) -> None:
        for _ in range(min(max(round(dt * self.task.freq), 1), MOST)):
            self._predict()
        if not self.task.stale("z") and np.isfinite(self.z).all():
            self._correct()
        self._u[:] = self.u

    def _predict(self) -> None:
        self.x[:] = self._a @ self.x + self._b @ self._u
        if np.trace(self._p) < UNKNOWN:
            self._p = self._a @ self._p @ self._a.T + self._q

    def _correct(self) -> None:
        c, p = self._c, self._p
        seen = c @ p
        gain = np.linalg.solve(seen @ c.T + self._r, seen).T.astype(np.float64)
        self.x += gain @ (self.z - c @ self.x)
        rest = self._eye - gain @ c
        self._p = rest @ p @ rest.T + gain @ self._r @ gain.T

    def _take_system(self) -> None:
        k, n = self.params, self.x.size
        self._eye = np.eye(n)
        self._a = grid(k.a, n, n, "a")
        self._b = grid(k.b, n, self.u.size, "b")
        self._c = grid(k.c, self.z.size, n, "c")
        self._q = _covariance(k.q, n, "q")
        self._r = _covariance(k.r, self.z.size, "r", definite=True)
        self._p0 = _covariance(k.p0, n, "p0")


def _covariance(
    values: PerElement, n: int, name: str, *, definite: bool = False
) -> Matrix:
    """Return the covariance that a parameter gives.

    Raises:
        ParameterError: It is not symmetric, or has a negative eigenvalue; or one of 0
            where it must be definite.
    """
    found = square(values, n, name)
    lowest = float(np.linalg.eigvalsh(found)[0])
    least = -1e-12 * float(np.abs(found).max())  # what rounding leaves of 0
    small = lowest <= 0.0 if definite else lowest < least
    if small or not np.array_equal(found, found.T):
        raise ParameterError(
            f"parameter {name} is no covariance",
            expected="a symmetric matrix with eigenvalues "
            + ("above 0" if definite else "of 0 or more"),
            got=" ".join(f"{value:g}" for value in values),
            remedy="correct it; variances are squares of standard deviations",
        )
    return found
