"""The criticality and priority of each task of an RTPU (Stewart 1994, 6.2.3, 4.5.1).

The rule is the one by which a configuration is verified, `legality.criticalities`;
here it is applied to what runs. All tasks of the RTPU count, whatever their subsystem,
because they share its core; so no single master could do this.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from msgspec import Struct, structs

from pbonet.analysis.legality import Task, criticalities
from pbonet.analysis.schedule import ASSUMED, CoreShare, dropped
from pbonet.config import Scheduler

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.analysis.schedule import CoreStatus, Probe
    from pbonet.config import Rmod, RtpuEntry


class RankRequest(Struct, kw_only=True):
    """A task before it is ranked."""

    name: str
    rmod: Rmod
    freq: float
    """Hz; 0 where the task is not periodic."""
    on: bool = True
    """Whether it is ON, or about to be."""
    told: tuple[int | None, int] | None = None
    """Criticality (None: the rule's) and priority that the master gave."""
    spawn_crit: int | None = None
    priority: int = 0


class Ranked(Struct, frozen=True):
    """The rank of a task."""

    crit: int
    priority: int
    assumed: bool
    drop: int = 0
    """Criticality once its reserve is used up."""


class CoreBudget:
    """The share of a core that tasks may use: what the kernel grants, less dispatching.

    The dispatcher's CPU time for each release is the mean since the present leader
    leads, in steps, so that it seldom changes: criticalities depend on it. Before the
    first `ENOUGH` releases it is assumed.

    Args:
        probe: What the kernel grants.
        wanted: ``core_share`` of the ``agent.toml``, which takes precedence.
        below: The dispatcher runs on the tasks' core; else it takes nothing of it.
    """

    ENOUGH: Final = 2000
    STEP: Final = 5e-6

    def __init__(self, probe: Probe, wanted: float | None, *, below: bool) -> None:
        self._share, self._reason = probe.share, probe.share_reason
        if not below:
            self._share, self._reason = 1.0, "timing is soft, and no throttle applies"
        if wanted is not None:
            self._share, self._reason = wanted, "core_share of agent.toml"
        self._below, self._measured = below, False
        self._seconds = ASSUMED.dispatch
        self._leader = self._releases = self._cpu_ns = 0

    def update(self, core: CoreStatus, cpu_ns: int) -> bool:
        """Take the present counts; return whether the share has changed.

        Args:
            core: The dispatcher's entries in the core table.
            cpu_ns: CPU time of its thread.
        """
        if core.leader_tid != self._leader:
            self._leader = core.leader_tid
            self._releases, self._cpu_ns = core.releases, cpu_ns
        releases = core.releases - self._releases
        if not self._below or releases < self.ENOUGH:
            return False
        mean = (cpu_ns - self._cpu_ns) * 1e-9 / releases
        before = self._seconds
        if self._measured and before - 1.5 * self.STEP < mean <= before:
            return False  # it is within its step, or little below
        self._measured = True
        self._seconds = max(math.ceil(mean / self.STEP), 1) * self.STEP
        return before != self._seconds

    def share(self) -> CoreShare:
        """Return what tasks may use now."""
        if not self._below:
            return CoreShare(share=self._share, reason=self._reason)
        how = "measured" if self._measured else "assumed"
        return CoreShare(
            share=self._share,
            dispatch=self._seconds,
            reason=f"{self._reason}; {self._seconds * 1e6:g} us a release, {how}",
        )


def rank(
    rtpu: RtpuEntry, wishes: Iterable[RankRequest], core: CoreShare
) -> dict[str, Ranked]:
    """Return the rank of every task.

    The tasks that are ON share the core among themselves. One that is OFF takes nothing
    from them, and is ranked as if all were ON.

    Args:
        rtpu: Gives its scheduler and its range of frequencies.
        wishes: Every task of the RTPU.
        core: What they may use of their core.
    """
    wishes = list(wishes)
    everything = [(wish.on, _task(wish, rtpu.name)) for wish in wishes]
    running = [task for on, task in everything if on]
    assigned = criticalities([task for _, task in everything], rtpu, core=core)
    if len(running) < len(everything):
        assigned |= criticalities(running, rtpu, core=core)
    return {
        wish.name: Ranked(
            crit=assigned[wish.name].crit,
            priority=wish.priority if wish.told is None else wish.told[1],
            assumed=assigned[wish.name].assumed,
            drop=dropped(
                assigned[wish.name].crit,
                fixed_rates=rtpu.scheduler is Scheduler.RM,
                server=wish.rmod.capacity is not None,
            ),
        )
        for wish in wishes
    }


def _task(wish: RankRequest, rtpu: str) -> Task:
    """Return a task in the form of the rule, with the criticality set for it, if any.

    The master's value goes before the RMOD's.
    """
    told = wish.told[0] if wish.told is not None else wish.spawn_crit
    rmod = wish.rmod if told is None else structs.replace(wish.rmod, crit=told)
    return Task(rmod=rmod, rtpu=rtpu, freq=wish.freq or None, task=wish.name)
