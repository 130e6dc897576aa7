"""The update of `kernels` in Warp, one thread for each rollout.

Sums over all rollouts are made of sums over `CHUNK` of them in a fixed order, so that
results repeat bit by bit on each device.
"""

# Warp reads the annotations of its kernels, so they are no text here.
# ruff: noqa: PLR0915, PLR0917
# mypy: ignore-errors
# pyright: basic, reportInvalidTypeForm=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAssignmentType=false
# pyright: reportGeneralTypeIssues=false, reportMissingImports=false

from types import SimpleNamespace
from typing import Any

import warp as wp

from pbonet.io.mppi.sizes import (
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
    SPEED,
    STEP,
    TEMPERATURE,
    key_of,
)

CHUNK = wp.constant(128)
"""Rollouts of a partial sum."""
FIRST = wp.constant(wp.uint32(ODD[0]))
SECOND = wp.constant(wp.uint32(ODD[1]))
PART = wp.constant(wp.float32(2.0**-24))
Joints = wp.types.vector(length=JOINTS, dtype=wp.float32)
TURN = wp.constant(wp.float32(6.283185307179586 * 2.0**-24))

wp.set_module_options({"enable_backward": False})


def update(
    m: Any,  # noqa: ANN401 - has the variables
    joints: int,
    steps: int,
    rollouts: int,
    seed: int,
    shift: float,
) -> None:
    """Improve the plan, as `kernels.update` does."""
    w = _working(m, joints, steps, rollouts)
    chunks = len(w.least)

    def launch(kernel: Any, dim: Any, *inputs: Any) -> None:  # noqa: ANN401
        wp.launch(kernel, dim, inputs=inputs, device=m.device)

    launch(shift_plan, (steps, joints), m.plan, w.plan, steps, shift)
    launch(
        rollout, rollouts, w.plan, m.joints, m.axes, m.tip, m.settings, m.state,
        m.goal, joints, steps, rollouts, wp.uint32(key_of(seed)), w.tried, w.cost,
    )  # fmt: skip
    launch(sum_costs, chunks, w.cost, w.least, w.sums, rollouts)
    launch(weigh, rollouts, w.cost, w.least, w.sums, m.settings, w.weight, rollouts)
    launch(
        sum_chunks, (chunks, steps * joints), w.tried, w.weight, w.parts, w.totals,
        rollouts,
    )  # fmt: skip
    m.plan.zero_()
    launch(finish_plan, (steps, joints), w.parts, w.totals, m.plan, joints, chunks)


def _working(m: Any, joints: int, steps: int, rollouts: int) -> SimpleNamespace:  # noqa: ANN401
    """Return arrays and the kernel for these sizes, made in the first call."""
    sizes = joints, steps, rollouts
    if getattr(m.local, "sizes", None) != sizes:
        chunks = -(-rollouts // CHUNK)

        def zeros(*shape: int) -> Any:  # noqa: ANN401 - Warp's own
            return wp.zeros(shape, dtype=wp.float32, device=m.device)

        m.local.sizes = sizes
        m.local.working = SimpleNamespace(
            plan=zeros(steps, joints),
            tried=zeros(steps * joints, rollouts),
            cost=zeros(rollouts),
            weight=zeros(rollouts),
            least=zeros(chunks),
            sums=zeros(chunks),
            parts=zeros(chunks, steps * joints),
            totals=zeros(chunks),
        )
    return m.local.working


@wp.func
def mixed(given: wp.uint32) -> wp.uint32:
    """Return a word in which each bit depends on every bit of the one given."""
    word = given ^ (given >> wp.uint32(16))
    word = word * FIRST
    word = word ^ (word >> wp.uint32(15))
    word = word * SECOND
    return word ^ (word >> wp.uint32(16))


@wp.func
def reach(room: wp.float32, most: wp.float32, dt: wp.float32) -> wp.float32:
    """Return the velocity from which a joint can stop within the room."""
    return most * (wp.sqrt(dt * dt + 2.0 / most * wp.max(room, 0.0)) - dt)


@wp.kernel
def shift_plan(
    old: wp.array2d(dtype=wp.float32),
    begun: wp.array2d(dtype=wp.float32),
    steps: int,
    shift: wp.float32,
):
    """Let the plan begin later; after its end it is 0."""
    t, j = wp.tid()
    at = wp.float32(t) + shift
    first = wp.min(int(at), steps)
    part = at - wp.float32(first)
    low = wp.float32(0.0)
    high = wp.float32(0.0)
    if first < steps:
        low = old[first, j]
    if first + 1 < steps:
        high = old[first + 1, j]
    begun[t, j] = (1.0 - part) * low + part * high


@wp.func
def hand(
    q: Joints,
    axes: wp.array2d(dtype=wp.float32),
    tip: wp.array(dtype=wp.float32),
    joints: int,
) -> wp.vec3:
    """Return the place of the hand."""
    place = wp.vec3(tip[0], tip[1], tip[2])
    for i in range(joints):
        j = joints - 1 - i
        axis = wp.vec3(axes[j, 0], axes[j, 1], axes[j, 2])
        arm = place - wp.vec3(axes[j, 3], axes[j, 4], axes[j, 5])
        way = wp.vec3(axes[j, 6], axes[j, 7], axes[j, 8])
        side = wp.cross(axis, arm)
        place = (
            place
            + wp.sin(q[j]) * side
            + (1.0 - wp.cos(q[j])) * wp.cross(axis, side)
            + q[j] * way
        )
    return place


@wp.kernel
def rollout(
    plan: wp.array2d(dtype=wp.float32),
    limits: wp.array2d(dtype=wp.float32),
    axes: wp.array2d(dtype=wp.float32),
    tip: wp.array(dtype=wp.float32),
    k: wp.array(dtype=wp.float32),
    state: wp.array2d(dtype=wp.float32),
    goal: wp.array(dtype=wp.float32),
    joints: int,
    steps: int,
    rollouts: int,
    key: wp.uint32,
    tried: wp.array2d(dtype=wp.float32),
    cost: wp.array(dtype=wp.float32),
):
    """Write what a rollout tries, and its cost."""
    r = wp.tid()
    q = Joints()
    v = Joints()
    change = Joints()
    later = Joints()
    for j in range(joints):
        q[j] = state[0, j]
        v[j] = state[1, j]
    dt = k[STEP]
    target = wp.vec3(goal[0], goal[1], goal[2])
    ball = wp.vec3(k[BALL], k[BALL + 1], k[BALL + 2])
    start = wp.length(hand(q, axes, tip, joints) - target)
    size = k[NOISE] * wp.min(1.0, k[FLOOR] + start / k[NEAR])
    if r == 0:
        size = wp.float32(0.0)
    rest = wp.sqrt(1.0 - k[KEEP] * k[KEEP])
    second = wp.uint32((steps + 1) // 2 * joints * rollouts)
    total = wp.float32(0.0)
    distance = wp.float32(0.0)
    for t in range(steps):
        odd = t % 2 == 1
        for j in range(joints):
            fresh = later[j]
            if not odd:
                at = wp.uint32((t // 2 * joints + j) * rollouts + r)
                one = wp.float32(mixed(at ^ key) >> wp.uint32(8))
                two = wp.float32(mixed((at + second) ^ key) >> wp.uint32(8))
                far = wp.sqrt(-2.0 * wp.log((one + 0.5) * PART))
                later[j] = far * wp.sin(two * TURN)
                fresh = far * wp.cos(two * TURN)
            if t == 0:
                change[j] = fresh
            else:
                change[j] = k[KEEP] * change[j] + rest * fresh
            most = limits[3, j]
            fast = limits[2, j]
            a = wp.clamp(plan[t, j] + size * most * change[j], -most, most)
            tried[t * joints + j, r] = a
            wish = v[j] + dt * a
            wish = wp.min(wish, wp.min(reach(limits[1, j] - q[j], most, dt), fast))
            wish = wp.max(wish, -wp.min(reach(q[j] - limits[0, j], most, dt), fast))
            wish = wp.min(wp.max(wish, v[j] - dt * most), v[j] + dt * most)
            v[j] = wish
            q[j] = q[j] + dt * wish
            share = a / most
            speed = wish / fast
            off = q[j] - limits[4, j]
            total += (
                k[EFFORT] * share * share
                + k[SPEED] * speed * speed
                + k[POSTURE] * off * off
            )
        place = hand(q, axes, tip, joints)
        distance = wp.length(place - target)
        total += k[DISTANT] * distance
        if k[INSIDE] > 0.0:
            gap = wp.length(place - ball)
            total += k[INSIDE] * wp.max(k[BALL + 3] - gap, 0.0)
    cost[r] = total + k[END] * distance


@wp.kernel
def sum_costs(
    cost: wp.array(dtype=wp.float32),
    least: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
    rollouts: int,
):
    """Write the least cost and the sum of the costs of each chunk."""
    c = wp.tid()
    lowest = cost[c * CHUNK]
    total = wp.float32(0.0)
    for r in range(c * CHUNK, wp.min((c + 1) * CHUNK, rollouts)):
        lowest = wp.min(lowest, cost[r])
        total += cost[r]
    least[c] = lowest
    sums[c] = total


@wp.kernel
def weigh(
    cost: wp.array(dtype=wp.float32),
    least: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
    k: wp.array(dtype=wp.float32),
    weight: wp.array(dtype=wp.float32),
    rollouts: int,
):
    """Write the weights; their sum is not 1 yet."""
    r = wp.tid()
    lowest = least[0]
    total = wp.float32(0.0)
    for c in range(least.shape[0]):
        lowest = wp.min(lowest, least[c])
        total += sums[c]
    mean = total / wp.float32(rollouts) - lowest
    weight[r] = wp.exp((lowest - cost[r]) / (k[TEMPERATURE] * mean + 1.0e-12))


@wp.kernel
def sum_chunks(
    tried: wp.array2d(dtype=wp.float32),
    weight: wp.array(dtype=wp.float32),
    parts: wp.array2d(dtype=wp.float32),
    totals: wp.array(dtype=wp.float32),
    rollouts: int,
):
    """Write the weighted sum of each chunk for each element of the plan."""
    c, i = wp.tid()
    part = wp.float32(0.0)
    total = wp.float32(0.0)
    for r in range(c * CHUNK, wp.min((c + 1) * CHUNK, rollouts)):
        part += weight[r] * tried[i, r]
        total += weight[r]
    parts[c, i] = part
    if i == 0:
        totals[c] = total


@wp.kernel
def finish_plan(
    parts: wp.array2d(dtype=wp.float32),
    totals: wp.array(dtype=wp.float32),
    plan: wp.array2d(dtype=wp.float32),
    joints: int,
    chunks: int,
):
    """Write the plan: the sums of all chunks by the sum of the weights."""
    t, j = wp.tid()
    part = wp.float32(0.0)
    total = wp.float32(0.0)
    for c in range(chunks):
        part += parts[c, t * joints + j]
        total += totals[c]
    plan[t, j] = part / total
