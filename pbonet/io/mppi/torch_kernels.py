"""The update of `kernels` in torch: with CUDA it is one graph.

All that changes from call to call is on the device, so that the graph, which is
captured in the first call of a size, is the whole update.
"""

# mypy: ignore-errors
# pyright: basic, reportMissingImports=false

from types import SimpleNamespace
from typing import Any

import torch

from pbonet.io.mppi.sizes import (
    BALL,
    DISTANT,
    EFFORT,
    END,
    FLOOR,
    INSIDE,
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

WARM_UP = 3
"""Runs before a graph is captured, in which torch allocates what it keeps."""
_TURN = 6.283185307179586 * 2.0**-24


def update(  # noqa: PLR0917 - as calls give them
    m: Any,  # noqa: ANN401 - has the variables
    joints: int,
    steps: int,
    rollouts: int,
    seed: int,
    shift: float,
) -> None:
    """Improve the plan, as `kernels.update` does."""
    with torch.no_grad():
        w = _working(m, joints, steps, rollouts)
        w.key.fill_(_signed(key_of(seed)))
        w.shift.fill_(shift)
        if w.graph is None:
            improve(m, w)
        else:
            w.graph.replay()


def _working(m: Any, joints: int, steps: int, rollouts: int) -> SimpleNamespace:  # noqa: ANN401
    """Return tensors and the graph for these sizes, made in the first call."""
    sizes = joints, steps, rollouts
    if getattr(m.local, "sizes", None) != sizes:
        on, pairs = m.device, (steps + 1) // 2
        count = 2 * pairs * joints * rollouts
        lag = torch.arange(steps, device=on)
        lag = (lag[:, None] - lag[None, :]).to(torch.float32)
        w = SimpleNamespace(
            joints=joints, steps=steps, rollouts=rollouts, graph=None,
            key=torch.zeros((), dtype=torch.int32, device=on),
            shift=torch.zeros((), dtype=torch.float32, device=on),
            counts=torch.arange(count, dtype=torch.int32, device=on).reshape(
                2, pairs, joints, rollouts
            ),
            times=torch.arange(steps, dtype=torch.float32, device=on),
            lag=lag.clamp(min=0.0),
            past=(lag >= 0.0).to(torch.float32),
            later=(torch.arange(steps, device=on) > 0).to(torch.float32),
        )  # fmt: skip
        m.local.sizes, m.local.working = sizes, w
        if torch.device(on).type == "cuda":
            w.graph = _captured(m, w)
    return m.local.working


def _captured(m: Any, w: SimpleNamespace) -> Any:  # noqa: ANN401 - torch's own
    """Return the graph of an update; the plan is as before."""
    kept = m.plan.clone()
    side = torch.cuda.Stream(m.device)
    side.wait_stream(torch.cuda.current_stream(m.device))
    with torch.cuda.stream(side):
        for _ in range(WARM_UP):
            improve(m, w)
    torch.cuda.current_stream(m.device).wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        improve(m, w)
    m.plan.copy_(kept)
    return graph


def improve(m: Any, w: SimpleNamespace) -> None:  # noqa: ANN401 - has the variables
    """Do what an update does, with nothing but tensors."""
    k, n = m.settings, w.joints
    limits = m.joints[:, :n, None]
    most = limits[3]
    plan = shifted(m.plan[: w.steps, :n], w)
    tried = smooth(normals(w), w, k[KEEP])
    start = hand(m, m.state[0, :n].reshape(1, n, 1))[:, 0, 0]
    share = k[FLOOR] + torch.linalg.vector_norm(start - m.goal) / k[NEAR]
    tried *= most * (k[NOISE] * share.clamp(max=1.0))
    tried[:, :, 0] = 0.0
    tried += plan[:, :, None]
    torch.clamp(tried, -most, most, out=tried)
    q, v = roll(m.state[:, :n], tried, limits, k[STEP])
    weight = weights(cost_of(m, tried, q, v, limits), k[TEMPERATURE])
    m.plan.zero_()
    m.plan[: w.steps, :n] = tried @ weight


def shifted(plan: Any, w: SimpleNamespace) -> Any:  # noqa: ANN401 - tensors
    """Return the plan as it begins later; after its end it is 0."""
    at = w.times + w.shift
    first = at.to(torch.int64).clamp(max=w.steps)
    part = (at - first)[:, None]
    longer = torch.cat((plan, torch.zeros_like(plan[:2])))
    return (1.0 - part) * longer[first] + part * longer[first + 1]


def normals(w: SimpleNamespace) -> Any:  # noqa: ANN401 - a tensor
    """Return numbers of a normal distribution, [steps, joints, rollouts]."""
    words = (mixed(w.counts ^ w.key) >> 8) & 0xFFFFFF
    size, turn = words.to(torch.float32)
    size = (size.add_(0.5).mul_(2.0**-24)).log_().mul_(-2.0).sqrt_()
    turn.mul_(_TURN)
    found = torch.stack((size * turn.cos(), size * turn.sin()), dim=1)
    return found.reshape(-1, w.joints, w.rollouts)[: w.steps]


def mixed(words: Any) -> Any:  # noqa: ANN401 - a tensor
    """Return words in which each bit depends on every bit of those given."""
    words ^= (words >> 16) & 0xFFFF
    words *= _signed(ODD[0])
    words ^= (words >> 15) & 0x1FFFF
    words *= _signed(ODD[1])
    words ^= (words >> 16) & 0xFFFF
    return words


def _signed(word: int) -> int:
    """Return the signed number of the same 32 bits."""
    return word - (1 << 32) if word >> 31 else word


def smooth(noise: Any, w: SimpleNamespace, keep: Any) -> Any:  # noqa: ANN401 - tensors
    """Return e_t = keep e_(t-1) + sqrt(1 - keep^2) n_t."""
    rest = 1.0 - w.later * (1.0 - (1.0 - keep * keep).sqrt())
    matrix = keep**w.lag * w.past * rest
    return (matrix @ noise.reshape(w.steps, -1)).reshape(noise.shape)


def roll(state: Any, tried: Any, limits: Any, dt: Any) -> tuple[Any, Any]:  # noqa: ANN401
    """Return positions and velocities of the joints, [steps, joints, rollouts]."""
    lower, upper, fast, most, _ = limits
    positions, velocities = torch.empty_like(tried), torch.empty_like(tried)
    q = state[0][:, None].expand(tried.shape[1:])
    v = state[1][:, None].expand(tried.shape[1:])
    change, square, twice = dt * most, dt * dt, 2.0 / most
    for t in range(len(tried)):
        up = reach(upper - q, square, twice, most, dt)
        down = reach(q - lower, square, twice, most, dt)
        wish = torch.addcmul(v, dt, tried[t])
        wish = torch.minimum(wish, torch.minimum(up, fast))
        wish = torch.maximum(wish, -torch.minimum(down, fast))
        v = torch.minimum(torch.maximum(wish, v - change), v + change)
        q = torch.addcmul(q, dt, v)
        positions[t], velocities[t] = q, v
    return positions, velocities


def reach(room: Any, square: Any, twice: Any, most: Any, dt: Any) -> Any:  # noqa: ANN401
    """Return the velocity from which a joint can stop within the room."""
    return most * ((square + twice * room.clamp(min=0.0)).sqrt() - dt)


def hand(m: Any, q: Any) -> Any:  # noqa: ANN401 - tensors
    """Return the place of the hand, [3, ...], for joints [..., joints, rollouts]."""
    sine, less = q.sin(), 1.0 - q.cos()
    place = m.tip[:, None, None].expand(3, q.shape[0], q.shape[2])
    for j in range(q.shape[1] - 1, -1, -1):
        axis, point, way = m.axes[j].reshape(3, 3)
        cross = torch.linalg.cross(
            axis.expand(3, 3), torch.eye(3, device=q.device), dim=1
        ).T
        both = torch.cat((cross, cross @ cross))
        arm = (place - point[:, None, None]).reshape(3, -1)
        turned = (both @ arm).reshape(2, *place.shape)
        place = torch.addcmul(place, sine[:, j], turned[0])
        place.addcmul_(less[:, j].expand_as(place), turned[1])
        place.addcmul_(way[:, None, None], q[:, j])
    return place


def cost_of(m: Any, tried: Any, q: Any, v: Any, limits: Any) -> Any:  # noqa: ANN401
    """Return the cost of each rollout."""
    k = m.settings
    _, _, fast, most, posture = limits
    place = hand(m, q)
    distance = torch.linalg.vector_norm(place - m.goal[:, None, None], dim=0)
    cost = k[DISTANT] * distance.sum(0) + k[END] * distance[-1]
    cost += k[EFFORT] * ((tried / most) ** 2).sum((0, 1))
    cost += k[SPEED] * ((v / fast) ** 2).sum((0, 1))
    cost += k[POSTURE] * ((q - posture) ** 2).sum((0, 1))
    gap = torch.linalg.vector_norm(place - k[BALL : BALL + 3, None, None], dim=0)
    cost += k[INSIDE] * (k[BALL + 3] - gap).clamp(min=0.0).sum(0)
    return cost


def weights(cost: Any, temperature: Any) -> Any:  # noqa: ANN401 - tensors
    """Return weights whose sum is 1: more for rollouts that cost less."""
    over = cost - cost.min()
    weight = torch.exp(-over / (temperature * over.mean() + 1e-12))
    return weight / weight.sum()
