"""Which criticality and priority each task of an RTPU has (Stewart 1994, 6.2.3, 4.5.1).

The rule is the one by which a configuration is verified, `legality.criticalities`;
here it is applied to what runs. All tasks of the RTPU count, whatever their subsystem,
because they share its core; so no single master could do this.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis.legality import Task, criticalities
from pbonet.analysis.schedule import PLANNED, dropped
from pbonet.config import Scheduler

if TYPE_CHECKING:
    from collections.abc import Iterable

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


def rank(rtpu: RtpuEntry, wishes: Iterable[RankRequest]) -> dict[str, Ranked]:
    """Return the rank of every task.

    The tasks that are ON share the core among themselves. One that is OFF takes nothing
    from them, and is ranked as if all were ON.

    Args:
        rtpu: Gives its scheduler and its range of frequencies.
        wishes: Every task of the RTPU.
    """
    wishes = list(wishes)
    everything = [(wish.on, _task(wish, rtpu.name)) for wish in wishes]
    running = [task for on, task in everything if on]
    assigned = criticalities([task for _, task in everything], rtpu, limit=PLANNED)
    if len(running) < len(everything):
        assigned |= criticalities(running, rtpu, limit=PLANNED)
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
