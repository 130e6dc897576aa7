"""A trajectory through given points, as a cubic or quintic spline."""

from math import perm
from typing import Annotated as A, Literal

import numpy as np

from pbonet import (
    InConst,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    Vector,
    param,
)
from pbonet.errors import ParameterError
from pbonet.modules._values import PerElement, rest


class Points(Params):
    """The points and their times."""

    time: A[PerElement, param("s", "when each point is reached, since `on`", gt=0)]
    points: A[
        PerElement,
        param("none", "NDOF values of each, or one for all, in the unit of Y"),
    ]
    order: A[
        Literal["cubic", "quintic"],
        param("none", "cubic: acceleration is continuous; quintic: jerk and snap too"),
    ] = "quintic"


class Spline(PortBasedObject[Points], module_class="trajectory"):
    """y = a spline from where Y stands through the points, at rest in the last one.

    It begins with the value that Y has when the module is turned on, at rest, or with
    the velocity and, if quintic, acceleration of a predecessor. A cubic spline has two
    continuous derivatives, a quintic one four (de Boor 1978). In the last point y
    rests, and the signal FINISH is sent. Between the points a spline may go beyond
    them: `limits` clips it.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Y")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the trajectory")]
    y_dot: A[Vector, OutVar("Y^", "ndof", "any", "its time derivative")]
    y_acc: A[Vector, OutVar("Y^^", "ndof", "any", "its second derivative")]

    def init(self) -> None:
        self._take_points()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        raise ParameterError(
            f"parameter {name} is read when the task is created",
            remedy="kill the task and spawn it again",
        )

    def on(self) -> None:
        rest(self.task, self.y_dot, self.y_acc)
        start = self.y, self.y_dot, self.y_acc
        self._pieces = spline_pieces(self._times, self._points, self._degree, start)
        self._time = 0.0

    def cycle(self, dt: float) -> None:
        before, end = self._time, float(self._times[-1])
        self._time = min(before + dt, end)
        if self._time < end:
            self._project(self._time)
        elif before < end:
            self.y[:] = self._points[-1]
            self.y_dot[:] = self.y_acc[:] = 0.0
            self.task.signal(Signal.FINISH)

    def off(self) -> None:
        rest(self.task, self.y_dot, self.y_acc)

    def _project(self, time: float) -> None:
        k = int(np.searchsorted(self._times, time, side="right")) - 1
        span = float(self._times[k + 1] - self._times[k])
        x, rows = (time - float(self._times[k])) / span, self._pieces[k]
        powers = x**self._exponents
        self.y[:] = powers @ rows
        self.y_dot[:] = (self._once * powers[:-1]) @ rows[1:] / span
        self.y_acc[:] = (self._twice * powers[:-2]) @ rows[2:] / span**2

    def _take_points(self) -> None:
        k, n = self.params, self.ndof
        self._times = np.concatenate(([0.0], k.time))
        if (np.diff(self._times) <= 0.0).any():
            raise ParameterError(
                "the times of a spline grow",
                expected="each one later than the one before",
                got=" ".join(f"{t:g}" for t in k.time),
                remedy="sort the points by time",
            )
        count = len(k.time)
        if len(k.points) not in {count, n * count}:
            raise ParameterError(
                "parameter points has the wrong number of values",
                expected=f"{n * count}: {n} for each of the {count} values of TIME; or "
                "one for each",
                got=f"{len(k.points)} values",
                remedy=f"give each point {n}",
            )
        rows = np.reshape(k.points, (count, -1))
        self._points = np.array(np.broadcast_to(rows, (count, n)), dtype=np.float64)
        self._degree = degree = 3 if k.order == "cubic" else 5
        self._exponents = np.arange(degree + 1)
        self._once, self._twice = derived(degree, 1), derived(degree, 2)


def derived(degree: int, order: int) -> Vector:
    """Return the factors of a polynomial's coefficients in one of its derivatives."""
    return np.array([float(perm(k, order)) for k in range(order, degree + 1)])


def spline_pieces(
    times: Vector, points: Matrix, degree: int, start: tuple[Vector, Vector, Vector]
) -> Matrix:
    """Return the coefficients of a spline, [pieces, degree + 1, n].

    Piece k is a polynomial of the share of its time, from `times[k]` on.

    Args:
        times: When the start, then each point is reached, s.
        points: The points after the start.
        degree: 3 or 5.
        start: Value, velocity and acceleration of the start; a cubic spline has no
            choice of its acceleration.
    """
    m, width, spans = len(points), degree + 1, np.diff(times)
    n = points.shape[1]
    left, right = np.zeros((m * width, m * width)), np.zeros((m * width, n))
    values = np.vstack((start[0], points))
    ends = range(1, (degree + 1) // 2)
    row = 0
    for k in range(m):
        here = slice(k * width, (k + 1) * width)
        left[row, k * width], right[row] = 1.0, values[k]
        left[row + 1, here], right[row + 1] = 1.0, values[k + 1]
        row += 2
        for order in range(1, degree) if k + 1 < m else ():
            left[row, k * width + order : (k + 1) * width] = (
                derived(degree, order) / spans[k] ** order
            )
            left[row, (k + 1) * width + order] = -perm(order) / spans[k + 1] ** order
            row += 1
    for order in ends:
        left[row, order], right[row] = perm(order) / spans[0] ** order, start[order]
        left[row + 1, -width + order :] = derived(degree, order)
        row += 2
    pieces: Matrix = np.linalg.solve(left, right).astype(np.float64)
    return pieces.reshape(m, width, n)
