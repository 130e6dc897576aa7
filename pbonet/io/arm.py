"""A simulated arm with the interface of a real one.

A robot-interface module sends torques and reads joint angles and velocities. Here they
come from the equations of motion of the published arm, with its motors' inertia and the
friction of its gears, instead of from amplifiers and encoders. Only `advance` differs
from a real arm, which needs no call for time to pass.

The integration is semi-implicit with sub-steps: viscous and Coulomb friction and the
end stops act on the velocity at the end of a step. So a joint sticks when friction can
hold it and slips when it cannot, exactly and without chatter, at any step.
"""

from __future__ import annotations

from functools import cache, lru_cache
from importlib import import_module
from math import ceil, inf
from typing import TYPE_CHECKING, Any

import numpy as np

from .chain import Chain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from .puma560 import ArmData

    Floats = NDArray[np.float64]
    Bounds = Sequence[tuple[float, float]]
    Signs = tuple[int, ...]


class SimulatedArm:
    """The equations of motion of an arm, advanced as time passes.

    It starts with its brakes on. Like a real drive it brakes by itself when no torque
    command has come for `watchdog` seconds; that also bounds the work of `advance`.

    Args:
        data: The arm's numbers.
        substep: Longest integration step, seconds. At 1 ms the joints of an arm that
            swings are within 1 mrad of where steps sixteen times as short take them.
        watchdog: Seconds that a torque command is good for.
    """

    def __init__(
        self, data: ArmData, *, substep: float = 1e-3, watchdog: float = 0.1
    ) -> None:
        self.data = data
        self.chain = Chain(data.dh, data.mass, data.com, data.inertia, data.rotor)
        self.braked = True
        self._substep = substep
        self._watchdog = watchdog
        self._since_command = 0.0
        self._q = np.zeros(data.ndof)
        self._qd = np.zeros(data.ndof)
        self._torque = np.zeros(data.ndof)
        self._stops = np.stack((data.lower, data.upper), axis=1).tolist()
        self._take_step(substep)
        _cholesky()  # loads a package, for which no cycle has the time

    @property
    def q(self) -> Floats:
        """Joint angles as measured by the encoders, rad."""
        return self._q

    @property
    def qd(self) -> Floats:
        """Joint velocities, rad/s."""
        return self._qd

    def place(self, q: ArrayLike, qd: ArrayLike) -> None:
        """Put the arm somewhere, which can be done to a simulated one only."""
        np.clip(q, self.data.lower, self.data.upper, out=self._q)
        self._qd[:] = qd

    def release_brakes(self) -> None:
        """Let the motors carry the arm; a command must follow within the watchdog."""
        self.braked = False
        self._since_command = 0.0
        self._torque[:] = 0.0

    def brake(self) -> None:
        """Stop the arm where it is and cut the motors off."""
        self.braked = True
        self._qd[:] = 0.0
        self._torque[:] = 0.0

    def command(self, torque: Floats) -> None:
        """Set the motors' torques at the joints, N*m; the drives limit them."""
        torque.clip(-self.data.torque, self.data.torque, out=self._torque)
        self._since_command = 0.0

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        if self.braked:
            return
        left = self._watchdog - self._since_command
        self._since_command += dt
        steps = max(1, ceil(min(dt, left) / self._substep))
        for _ in range(steps):
            self._step(min(dt, left) / steps)
        if dt > left:
            self.brake()

    def _take_step(self, h: float) -> None:
        """Have what depends on nothing but the length of a step, seconds."""
        self._h = h
        self._damping = h * np.diag(self.data.viscous)
        columns = (-self.data.coulomb_down, self.data.coulomb_up)
        self._slipping: Bounds = (h * np.stack(columns, axis=1)).tolist()

    def _step(self, h: float) -> None:
        """Advance by `h`: M v' + h (D v' + f) = M v + h (torque - bias), q' = q + h v'.

        The friction f lies between its bounds, and is at one of them while v' is not
        zero. An end stop is a bound without end.
        """
        if h != self._h:
            self._take_step(h)
        mass = self.chain.mass_matrix(self._q)
        push = self._torque - self.chain.bias(self._q, self._qd)
        push *= h
        push += mass.dot(self._qd)
        self._qd[:] = solve_with_friction(
            mass + self._damping, push, self._bounds(), self._qd
        )
        self._q += h * self._qd
        np.minimum(self._q, self.data.upper, out=self._q)
        np.maximum(self._q, self.data.lower, out=self._q)

    def _bounds(self) -> Bounds:
        """Return the bounds of the friction: at an end stop it gives way to none."""
        # a handful of numbers: plain Python is faster here than numpy's calls would be
        angles = self._q.tolist()
        for q, (lower, upper) in zip(angles, self._stops, strict=True):
            if not lower < q < upper:
                break
        else:
            return self._slipping
        rows = zip(angles, self._stops, self._slipping, strict=True)
        return [
            (-inf if q <= lower else down, inf if q >= upper else up)
            for q, (lower, upper), (down, up) in rows
        ]


def solve_with_friction(
    matrix: Floats, push: Floats, bounds: Bounds, guess: Floats
) -> Floats:
    """Return the velocity v with matrix v + f = push and Coulomb friction f.

    With bounds (low, high), f[i] = high where v[i] > 0, low where v[i] < 0, and between
    them where v[i] is 0. For a symmetric positive definite matrix there is exactly one
    such v. Signs are guessed and corrected all at once, which usually takes one or two
    rounds; if that cycles, only the first wrong sign is corrected, which ends for
    certain (the principal pivoting of Judice and Pires 1994).

    Args:
        matrix: Symmetric positive definite, n by n.
        push: n momenta.
        bounds: n times the bounds of the friction: one at most 0, or minus infinity
            for a stop, and one at least 0, or infinity for a stop.
        guess: A velocity whose signs are likely right.
    """
    signs = tuple([  # nothing moves into a stop
        1 if v > 0.0 and high < inf else -1 if v < 0.0 and low > -inf else 0
        for v, (low, high) in zip(guess.tolist(), bounds, strict=True)
    ])
    rounds = 0
    while True:
        velocity, friction = _with_signs(matrix, push, bounds, signs)
        better = _corrected(signs, velocity.tolist(), friction, bounds, push)
        if better == signs:
            return velocity
        if rounds > _ALL_AT_ONCE:
            first = next(i for i, sign in enumerate(signs) if sign != better[i])
            better = (*signs[:first], better[first], *signs[first + 1 :])
        signs = better
        rounds += 1


_ALL_AT_ONCE = 10
"""Rounds in which every wrong sign is corrected."""


def _corrected(
    signs: Signs,
    velocity: list[float],
    friction: list[float],
    bounds: Bounds,
    push: Floats,
) -> Signs:
    """Return the signs that the joints' velocities should have been given."""
    better: list[int] = []
    rows = zip(signs, velocity, friction, bounds, strict=True)
    for sign, v, f, (low, high) in rows:
        if sign:
            better.append(0 if v * sign < 0 else sign)
        elif low <= f <= high:
            better.append(0)
        else:
            slack = 1e-12 * (1.0 + abs(push.item(len(better))))
            better.append((f > high + slack) - (f < low - slack))
    return tuple(better)


def _with_signs(
    matrix: Floats, push: Floats, bounds: Bounds, signs: Signs
) -> tuple[Floats, list[float]]:
    """Return velocity and friction if the joints slip, or stick, as `signs` say."""
    if not any(signs):
        return np.zeros_like(push), push.tolist()
    friction = [
        pair[sign > 0] if sign else 0.0
        for sign, pair in zip(signs, bounds, strict=True)
    ]
    load = push - np.array(friction)
    if all(signs):
        return _solve(matrix, load), friction
    free, both, stuck = _masks(signs)
    load *= free
    reduced = matrix * both
    reduced.ravel()[:: len(signs) + 1] += stuck
    velocity = _solve(reduced, load)
    needed = (push - matrix.dot(velocity)).tolist()
    return velocity, [
        slip if sign else stick
        for sign, slip, stick in zip(signs, friction, needed, strict=True)
    ]


@lru_cache(maxsize=1024)
def _masks(signs: Signs) -> tuple[Floats, Floats, Floats]:
    """Return 1 for who slips, for pairs that slip, and for who sticks; else 0."""
    free = np.array(signs, dtype=np.float64) ** 2
    return free, free * free[:, None], 1.0 - free


def _solve(matrix: Floats, load: Floats) -> Floats:
    """Return matrix^-1 load; by Cholesky, as the matrix is positive definite."""
    solution: Floats = _cholesky()(matrix).solve(load)
    return solution.ravel()  # it takes a load of one number for a matrix


@cache
def _cholesky() -> Any:  # noqa: ANN401 - it has no stubs
    """Return Eigen's LLT, which pinocchio brings; numpy's takes five times as long."""
    return import_module("eigenpy").LLT
