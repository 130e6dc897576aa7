"""A motion that was shown once, to any goal: a dynamic movement primitive."""

from math import exp, isfinite
from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    Vector,
    param,
)
from pbonet.io import Samples, read_samples
from pbonet.modules._values import keep, rest

DECAY = 4.6
"""The phase goes from 1 to exp(-DECAY), a hundredth, in DURATION."""


class Shown(Params):
    """The motion that was shown, and how it is made again."""

    file: A[str, param("none", ".csv or .npz file, in a folder of modules")]
    duration: A[
        float, param("s", "0: as shown; a new one counts from the next on", ge=0)
    ] = 0.0
    stiffness: A[float, param("none", "K, with times in DURATION", gt=0)] = 400.0
    count: A[int, param("none", "bumps that the shape is made of", ge=2, le=200)] = 30


class Dmp(PortBasedObject[Shown], module_class="trajectory"):
    """T^2 y'' = K (g - y) - 2 sqrt(K) T y' - K (g - y0) x + K f(x), T x' = -4.6 x.

    A spring draws y to the goal g while the force f makes the shape of a motion that
    was shown, and fades with the phase x (Ijspeert et al. 2013; in the form of Pastor
    et al. 2009, which starts and goal do not distort). T is DURATION, y0 where y stood
    when there first was a goal. f is a sum of COUNT bumps over x, fitted in `init` to
    the samples of FILE, which `traj_play` describes, by least squares. It is held
    between two cycles; for the rest the equation is solved exactly.

    The goal may change at any time: y and its velocity go on without a jump. While
    there is none, because Y_DES is not finite, y comes to rest where it stood. At the
    end of DURATION the signal FINISH is sent; x, and f with it, go on fading.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Y")]
    y_des: A[Vector, InVar("Y_DES", "ndof", "any", "goal")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the motion")]
    y_dot: A[Vector, OutVar("Y^", "ndof", "any", "its time derivative")]
    y_acc: A[Vector, OutVar("Y^^", "ndof", "any", "its second derivative")]

    def init(self) -> None:
        k = self.params
        shown = read_samples(k.file, self.ndof, self.task.libraries)
        self._lasts = float(shown.time[-1] - shown.time[0])
        self._centers, self._widths = bumps(k.count)
        self._weights = fit(shown, k.stiffness, self._centers, self._widths)
        self._goal = np.zeros(self.ndof)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"file", "stiffness", "count"})

    def on(self) -> None:
        rest(self.task, self.y_dot, self.y_acc)
        self._duration = self.params.duration or self._lasts  # set() is for the next
        self._time = 0.0
        self._begun = self._ended = self._warned = False
        self._start = self.y.copy()
        self._goal[:] = self.y

    def cycle(self, dt: float) -> None:
        if all(map(isfinite, self.y_des.tolist())):
            if not self._begun:
                self._start[:] = self.y
            self._goal[:] = self.y_des
            self._begun, self._warned = True, False
        elif not self._warned:
            self._warned = True
            element = int(np.argmin(np.isfinite(self.y_des)))
            self.task.warn(f"Y_DES[{element}] is not finite: the last goal holds")
        self._go_on(self._drawn_to(), dt)
        if self._begun:
            self._time += dt
            if self._time >= self._duration and not self._ended:
                self._ended = True
                self.task.signal(Signal.FINISH)

    def off(self) -> None:
        rest(self.task, self.y_dot, self.y_acc)

    def _drawn_to(self) -> Vector:
        """Return where the spring is drawn to in this cycle."""
        if not self._begun:
            return self._goal
        x = exp(-DECAY * self._time / self._duration)
        drawn = shape(x, self._centers, self._widths) @ self._weights
        drawn += self._goal
        drawn -= x * (self._goal - self._start)
        return drawn

    def _go_on(self, to: Vector, dt: float) -> None:
        """Solve the equation of the critically damped spring over a cycle."""
        w = self.params.stiffness**0.5 / self._duration
        fade = exp(-w * dt)
        away = self.y - to
        pull = self.y_dot + w * away
        self.y[:] = to + fade * (away + dt * pull)
        self.y_dot[:] = fade * (pull - w * (away + dt * pull))
        self.y_acc[:] = w * w * (to - self.y) - 2.0 * w * self.y_dot


def bumps(count: int) -> tuple[Vector, Vector]:
    """Return centers and widths of bumps over the phase, evenly spaced in time."""
    centers = np.exp(-DECAY * np.linspace(0.0, 1.0, count))
    gaps = np.diff(centers)
    return centers, 1.0 / np.append(gaps, gaps[-1]) ** 2


def shape(x: float, centers: Vector, widths: Vector) -> Vector:
    """Return how much each bump counts at a phase."""
    heights = -widths * (x - centers) ** 2
    heights -= heights.max()  # one of them is 1, however far x is from the last center
    np.exp(heights, out=heights)
    heights *= x / heights.sum()
    found: Vector = heights
    return found


def fit(shown: Samples, stiffness: float, centers: Vector, widths: Vector) -> Matrix:
    """Return the weights of the bumps, [count, n], that make a motion of samples."""
    time = shown.time - shown.time[0]
    lasts = float(time[-1])
    rates, start, goal = shown.rates, shown.values[0], shown.values[-1]
    acceleration = np.gradient(rates, time, axis=0)
    x = np.exp(-DECAY * time / lasts)
    force = lasts**2 * acceleration + 2.0 * stiffness**0.5 * lasts * rates
    wanted = force / stiffness - (goal - shown.values) + np.outer(x, goal - start)
    counted = np.array([shape(float(one), centers, widths) for one in x])
    return np.asarray(np.linalg.lstsq(counted, wanted, rcond=None)[0], np.float64)
