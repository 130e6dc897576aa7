"""Effect of the order of two connected tasks on the data (section 6.2.4).

Task a samples a sensor and hands the value to task b, which puts it out. Both run when
the scheduler lets them; inputs are taken at the begin of a cycle and outputs given at
its end. The output is a staircase behind the sensor, and how far behind depends on who
goes first when both are ready (Figures 6.3 to 6.5 of Stewart 1994).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from .simulate import Core, PeriodicTask

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy.typing as npt

    from .outcome import Outcome

    Floats = npt.NDArray[np.float64]

ALPHA = 10.0
"""Of the thesis's signal, rad/s."""
K = 50.0
"""Its amplitude."""
MS = 1_000_000
STEPS = 2000
"""Instants a second at which the error is taken."""


class Chain(Struct, frozen=True, kw_only=True):
    """The two tasks of Figure 6.3."""

    period_a_ns: int = 50 * MS
    period_b_ns: int = 50 * MS
    cost_a_ns: int = 5 * MS
    cost_b_ns: int = 5 * MS
    a_first: bool = True
    """The task with the higher priority."""
    fixed: bool = True
    """The priority is a fixed one, above the deadline, as the figure has it; else it
    is MUF's user priority, which only decides between equal deadlines."""


class Signals(Struct, frozen=True):
    """The sensor's value and the output over time."""

    time_s: Floats
    ideal: Floats
    output: Floats

    @property
    def error(self) -> float:
        """The mean of the absolute difference."""
        return float(np.abs(self.output - self.ideal).mean())


def sine(time_s: Floats) -> Floats:
    """Return the thesis's signal, ``K sin(alpha t)``."""
    return K * np.sin(ALPHA * time_s)


def run(
    chain: Chain,
    seconds: float,
    *,
    settle: float = 1.0,
    signal: Callable[[Floats], Floats] = sine,
) -> Signals:
    """Schedule the two tasks and return what comes out.

    Args:
        chain: The tasks.
        seconds: Length of the analyzed time.
        settle: Seconds before that, so that the beginning does not count.
        signal: The sensor's value at instants in seconds.

    Raises:
        ValueError: The tasks miss deadlines, so that the order says nothing.
    """
    a = _Probe("a", chain.period_a_ns, chain.cost_a_ns)
    b = _Probe("b", chain.period_b_ns, chain.cost_b_ns)
    core = Core([
        a.task(chain, urgent=chain.a_first),
        b.task(chain, urgent=not chain.a_first),
    ])
    a.core = b.core = core
    core.run_until(round((seconds + settle) * 1e9))
    outcome = core.outcome()
    if outcome.missing:
        late = ", ".join(sorted(outcome.missing))
        msg = f"the chain is not schedulable: {late} missed deadlines"
        raise ValueError(msg)
    ends_a, ends_b = a.ends(outcome), b.ends(outcome)
    sampled = signal(np.array(a.begins[: len(ends_a)]) * 1e-9)
    handed = _held(ends_a, sampled, np.array(b.begins[: len(ends_b)]))
    at_ns = np.arange(settle, seconds + settle, 1.0 / STEPS, dtype=np.float64) * 1e9
    time_s = at_ns * 1e-9
    return Signals(time_s, signal(time_s), _held(ends_b, handed, at_ns))


class _Probe:
    """A task that notes when its cycles begin."""

    def __init__(self, name: str, period_ns: int, cost_ns: int) -> None:
        self.name, self.period_ns, self.cost_ns = name, period_ns, cost_ns
        self.begins: list[int] = []
        self.core: Core | None = None

    def __call__(self) -> int:
        assert self.core is not None  # noqa: S101
        self.begins.append(self.core.now_ns)
        return self.cost_ns

    def task(self, chain: Chain, *, urgent: bool) -> PeriodicTask:
        return PeriodicTask(
            name=self.name,
            period_ns=self.period_ns,
            cost=self,
            crit=5 + (urgent and chain.fixed),
            priority=int(urgent),
        )

    def ends(self, outcome: Outcome) -> npt.NDArray[np.int64]:
        """Return when the cycles ended; none was missed."""
        account = outcome.tasks[self.name]
        releases = np.array(account.releases_ns[: account.cycles], dtype=np.int64)
        return releases + np.array(account.responses_ns, dtype=np.int64)


def _held(
    changes_ns: npt.NDArray[np.int64], values: Floats, at_ns: npt.NDArray[np.generic]
) -> Floats:
    """Return the newest value at each instant; 0 before the first."""
    newest = np.searchsorted(changes_ns, at_ns, side="right")
    held: Floats = np.concatenate(([0.0], values))[newest]
    return held


def errors(
    periods_b_ns: Iterable[int], *, a_first: bool, seconds: float = 10.0
) -> Floats:
    """Return the mean error for each period of task b: a curve of Figure 6.5.

    Args:
        periods_b_ns: T_b; T_a is 50 ms and both cycles take 5 ms.
        a_first: The priority of task a is the greater one.
        seconds: Length of the analyzed time of each.
    """
    return np.array([
        run(Chain(period_b_ns=period, a_first=a_first), seconds).error
        for period in periods_b_ns
    ])
