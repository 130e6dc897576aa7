"""Kernels of model predictive path integral control of an arm, for a processor.

The library of `mppi_arm`: what one update computes is the same on each back end, from
the same random numbers. Arms of at most `JOINTS` joints and plans of at most `STEPS`
steps use the upper left part of the variables. The back ends for Warp and torch stand
in `warp_kernels` and `torch_kernels`; here is that of numpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet.io.mppi.sizes import (
    AXIS,
    BALL,
    DISTANT,
    EFFORT,
    END,
    FLOOR,
    INSIDE,
    JOINTS,
    KEEP,
    NEAR,
    NOISE,
    ODD,
    POSTURE,
    SETTINGS,
    SPEED,
    STEP,
    STEPS,
    TEMPERATURE,
    key_of,
)
from pbonet.io.spp import Library

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float32]
    Words = NDArray[np.uint32]

library = Library()
library.variable("joints", (5, JOINTS), "f4")  # lower, upper, velocity, acc., posture
library.variable("axes", (JOINTS, AXIS), "f4")  # axis, a point on it, way of sliding
library.variable("tip", 3, "f4")  # the hand when all joints are 0, m
library.variable("settings", SETTINGS, "f4")
library.variable("state", (2, JOINTS), "f4")  # position and velocity of the joints
library.variable("goal", 3, "f4")  # of the hand, m
library.variable("plan", (STEPS, JOINTS), "f4")  # accelerations
library.variable("begun", (), "f8")  # when the state was measured, s; kept for clients

_ONE: Final = np.float32(1.0)


@library.routine("numpy")
def update(  # noqa: PLR0917 - as calls give them
    m: Any,  # noqa: ANN401 - has the variables
    joints: int,
    steps: int,
    rollouts: int,
    seed: int,
    shift: float,
) -> None:
    """Improve the plan: shift it, try changes of it, and take their weighted mean.

    Args:
        m: The variables.
        joints: Of the arm.
        steps: Of the plan.
        rollouts: Changes that are tried; the first is none.
        seed: Which random numbers.
        shift: Steps that have passed since the last plan began.
    """
    k = m.settings
    limits = m.joints[:, :joints, None]
    plan = shifted(m.plan[:steps, :joints], shift)
    low, most = -limits[3], limits[3]
    tried = normals(m.local, seed, steps, joints, rollouts)
    tried = (_filter(m.local, steps, k[KEEP]) @ tried.reshape(steps, -1)).reshape(
        tried.shape
    )
    tried *= most * spread_of(k, away(m, m.state[0, :joints]))
    tried[:, :, 0] = 0.0
    tried += plan[:, :, None]
    np.clip(tried, low, most, out=tried)
    q, v = roll(m.state[:, :joints], tried, limits, k[STEP])
    cost = cost_of(m, tried, q, v, limits)
    weight = weights(cost, k[TEMPERATURE])
    m.plan[:] = 0.0
    m.plan[:steps, :joints] = tried @ weight


def shifted(plan: Floats, shift: float) -> Floats:
    """Return the plan as it begins `shift` steps later; after its end it is 0."""
    steps = len(plan)
    at = np.arange(steps) + shift
    first = np.minimum(at.astype(np.int64), steps)
    part = np.asarray(at - first, dtype=np.float32)[:, None]
    longer = np.vstack((plan, np.zeros_like(plan[:2])))
    found = (_ONE - part) * longer[first] + part * longer[first + 1]
    return np.asarray(found, dtype=np.float32)


def spread_of(settings: Floats, distance: float) -> np.float32:
    """Return how much is tried, as a share of the acceleration: less near the goal."""
    share = settings[FLOOR] + np.float32(distance) / settings[NEAR]
    return np.float32(settings[NOISE] * min(_ONE, share))


def normals(local: Any, seed: int, steps: int, joints: int, rollouts: int) -> Floats:  # noqa: ANN401
    """Return numbers of a normal distribution, [steps, joints, rollouts]."""
    pairs = (steps + 1) // 2
    shape = (2, pairs, joints, rollouts)
    if getattr(local, "shape", None) != shape:
        local.shape = shape
        local.counts = np.arange(np.prod(shape), dtype=np.uint32).reshape(shape)
    words = mixed(local.counts ^ np.uint32(key_of(seed))) >> np.uint32(8)
    size, turn = words.astype(np.float32)
    size = np.sqrt(np.float32(-2.0) * np.log((size + np.float32(0.5)) * _PART))
    turn *= _TURN
    found = np.empty((pairs, 2, joints, rollouts), np.float32)
    np.multiply(size, np.cos(turn), out=found[:, 0])
    np.multiply(size, np.sin(turn), out=found[:, 1])
    return found.reshape(2 * pairs, joints, rollouts)[:steps]


_PART: Final = np.float32(2.0**-24)
_TURN: Final = np.float32(2.0 * np.pi * 2.0**-24)


def mixed(words: Words) -> Words:
    """Return words in which each bit depends on every bit of those given."""
    words ^= words >> np.uint32(16)
    words *= np.uint32(ODD[0])
    words ^= words >> np.uint32(15)
    words *= np.uint32(ODD[1])
    words ^= words >> np.uint32(16)
    return words


def _filter(local: Any, steps: int, keep: np.float32) -> Floats:  # noqa: ANN401
    """Return the matrix that makes e_t = keep e_(t-1) + sqrt(1 - keep^2) n_t of n."""
    if getattr(local, "filter_of", None) != (steps, keep):
        local.filter_of = steps, keep
        lag = np.subtract.outer(np.arange(steps), np.arange(steps))
        matrix = np.tril(float(keep) ** np.maximum(lag, 0))
        matrix[:, 1:] *= np.sqrt(1.0 - float(keep) ** 2)
        local.filter = matrix.astype(np.float32)
    found: Floats = local.filter
    return found


def roll(
    state: Floats, tried: Floats, limits: Floats, dt: np.float32
) -> tuple[Floats, Floats]:
    """Return positions and velocities of the joints, [steps, joints, rollouts].

    An acceleration acts as far as the limits allow: of velocity, of acceleration, and
    a velocity from which the joint can stop before its limit of position.
    """
    lower, upper, fast, most, _ = limits
    positions, velocities = np.empty_like(tried), np.empty_like(tried)
    q = np.repeat(state[0][:, None], tried.shape[2], axis=1)
    v = np.repeat(state[1][:, None], tried.shape[2], axis=1)
    change = dt * most
    square, twice = dt * dt, np.float32(2.0) / most
    for t, acceleration in enumerate(tried):
        up = most * (np.sqrt(square + twice * np.maximum(upper - q, 0.0)) - dt)
        down = most * (np.sqrt(square + twice * np.maximum(q - lower, 0.0)) - dt)
        wish = v + dt * acceleration
        np.minimum(wish, np.minimum(up, fast), out=wish)
        np.maximum(wish, -np.minimum(down, fast), out=wish)
        v = np.minimum(np.maximum(wish, v - change), v + change)
        q = q + dt * v
        positions[t], velocities[t] = q, v
    return positions, velocities


def hand(m: Any, q: Floats) -> Floats:  # noqa: ANN401 - has the variables
    """Return the place of the hand, [3, ...], for joints [..., joints, rollouts]."""
    sine, less = np.sin(q), _ONE - np.cos(q)
    place = np.empty((3, q.shape[0], q.shape[2]), np.float32)
    place[:] = m.tip[:, None, None]
    for j in range(q.shape[1] - 1, -1, -1):
        axis, point, way = m.axes[j].reshape(3, 3)
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], np.float32)
        both = np.vstack((cross, cross @ cross))
        arm = (place - point[:, None, None]).reshape(3, -1)
        turned = (both @ arm).reshape(2, *place.shape)
        place += sine[:, j] * turned[0] + less[:, j] * turned[1]
        if way.any():
            place += way[:, None, None] * q[:, j]
    return place


def away(m: Any, q: Floats) -> float:  # noqa: ANN401 - has the variables
    """Return how far the hand is from the goal with joints at `q`."""
    place = hand(m, q[None, :, None])[:, 0, 0]
    return float(np.sqrt(((place - m.goal) ** 2).sum()))


def cost_of(
    m: Any,  # noqa: ANN401 - has the variables
    tried: Floats,
    q: Floats,
    v: Floats,
    limits: Floats,
) -> Floats:
    """Return the cost of each rollout."""
    k = m.settings
    _, _, fast, most, posture = limits
    place = hand(m, q)
    distance = np.sqrt(((place - m.goal[:, None, None]) ** 2).sum(axis=0))
    cost = k[DISTANT] * distance.sum(axis=0) + k[END] * distance[-1]
    cost += k[EFFORT] * ((tried / most) ** 2).sum(axis=(0, 1))
    cost += k[SPEED] * ((v / fast) ** 2).sum(axis=(0, 1))
    cost += k[POSTURE] * ((q - posture) ** 2).sum(axis=(0, 1))
    if k[INSIDE] > 0.0:
        centre, radius = k[BALL : BALL + 3, None, None], k[BALL + 3]
        gap = np.sqrt(((place - centre) ** 2).sum(axis=0))
        cost += k[INSIDE] * np.maximum(radius - gap, 0.0).sum(axis=0)
    return np.asarray(cost, dtype=np.float32)


def weights(cost: Floats, temperature: np.float32) -> Floats:
    """Return weights whose sum is 1: more for rollouts that cost less."""
    over = cost - cost.min()
    mean = np.float32(over.mean())
    weight = np.exp(-over / (temperature * mean + np.float32(1e-12)))
    found: Floats = weight / weight.sum()
    return found


@library.routine("warp", "update")
def update_by_warp(m: Any, *numbers: float) -> None:  # noqa: ANN401
    """The same in Warp; the first call compiles it, so that `init` need not wait."""
    from pbonet.io.mppi import warp_kernels

    warp_kernels.update(m, *numbers)  # type: ignore[arg-type] # whole numbers are whole


@library.routine("torch", "update")
def update_by_torch(m: Any, *numbers: float) -> None:  # noqa: ANN401
    """The same in torch."""
    from pbonet.io.mppi import torch_kernels

    torch_kernels.update(m, *numbers)  # type: ignore[arg-type] # whole numbers are whole
