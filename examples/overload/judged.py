"""What must come out of the overload under each scheduler, and whether it did.

In every burst all four tasks are released at once, and together they ask for more than
there is until its end. Some things then follow, whatever else happens on the machine:

- under MUF tau4 misses: the other three leave it 1 unit in 60;
- under RM tau3 misses and tau4 does: before the first deadline of each, those above it
  take so much that not enough is left;
- under EDF others than tau4 miss: it puts off whoever has the latest deadline, and so
  everybody in turn. Who it is rests on ties and on microseconds.

That the others do not miss is true as long as they have the core. In every stretch from
a release to a deadline, what tau1 to tau3 ask for leaves at least one unit, and what
tau1 and tau2 ask for leaves two. So a miss proves that at least a unit of the core was
taken away: the machine stood still, or others had it. The kernel's count of CPU time
tells: where the tasks got the core and the time is in nobody's account, it was not
theirs. A cycle that used more than its reserve loses its criticality, and that excuses
its own miss too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec import Struct

if TYPE_CHECKING:
    from seen import Busy, History

UNIT_NS: Final = 3_000_000
TASKS: Final = {"tau1": (6, 2), "tau2": (10, 4), "tau3": (12, 3), "tau4": (15, 4)}
"""Period and CPU time, in units."""
SHARE: Final = 0.96
"""Of that CPU time which the tasks burn, as their RMODs say. The rest of their reserve
is for what is added to it: the switch, the copies, caches that others have used."""
SAFE: Final = {"MUF": ("tau1", "tau2", "tau3"), "RM": ("tau1", "tau2"), "EDF": ()}
"""Those that do not miss, as long as they have the core."""
BOUND: Final = {
    "MUF": (("tau4",),),
    "RM": (("tau3",), ("tau4",)),
    "EDF": (("tau1", "tau2", "tau3"),),
}
"""Groups of which at least one misses in every burst."""
CONDUCTOR: Final = "pulse"
_LEAST: Final = 0.9 * UNIT_NS
"""What must be missing; a unit, but for what the measuring takes."""


class Miss(Struct, frozen=True):
    """A deadline missed by a task that should not."""

    task: str
    begin_ns: int
    """Since then those that go before all others had the core without a break."""
    deadline_ns: int
    overran: bool = False
    """It had used more than its reserve."""
    away_ns: int = 0
    """How much of the core was not theirs since then."""

    @property
    def excused(self) -> bool:
        """Whether it says nothing about the scheduler."""
        return self.overran or self.away_ns >= _LEAST


class Judgement(Struct):
    """What the bursts of one scheduler say."""

    misses: list[Miss]
    """Of tasks that should not."""
    idle: list[str]
    """What should have been missed, and was not."""

    @property
    def faults(self) -> list[str]:
        """Return what should not be and has no excuse."""
        unexcused = [
            f"{miss.task} missed, though it had the core"
            for miss in self.misses
            if not miss.excused
        ]
        return unexcused + self.idle


def judge(history: History, scheduler: str, bursts: list[tuple[int, int]]) -> Judgement:
    """Judge every miss of a task that should not, and look for those that must.

    Args:
        history: Of the whole run.
        scheduler: MUF, RM or EDF.
        bursts: Begin and end of each, nanoseconds.
    """
    found = Judgement([], [])
    stretches = history.busy((*SAFE[scheduler], CONDUCTOR))
    for place, (begin, end) in enumerate(bursts, 1):
        found.idle += [
            f"burst {place}: {' and '.join(group)} missed nothing"
            for group in BOUND[scheduler]
            if not any(history.missed(task, begin, end) for task in group)
        ]
        found.misses += [
            _miss(history, stretches, task, deadline)
            for task in SAFE[scheduler]
            for deadline in history.missed(task, begin, end)
        ]
    return found


def _miss(history: History, stretches: list[Busy], task: str, deadline: int) -> Miss:
    """Return a miss with what excuses it."""
    if _overran(history, task, deadline):
        return Miss(task, deadline, deadline, overran=True)
    for busy in stretches:
        if busy.begin_ns < deadline <= busy.end_ns:
            more = sum(
                max(0, cycle.cpu_ns - TASKS[name][1] * UNIT_NS)
                for (name, _), cycle in busy.cycles.items()
                if name in TASKS
            )
            away = busy.lost_ns + more
            return Miss(task, busy.begin_ns, deadline, away_ns=away)
    return Miss(task, deadline, deadline)


def _overran(history: History, task: str, deadline: int) -> bool:
    """Tell whether the task had used up its reserve in the period before."""
    begin = deadline - TASKS[task][0] * UNIT_NS
    return any(
        one.task == task and one.spent
        for turn in history.turns
        if begin <= turn.now_ns <= deadline
        for one in turn.ready
    )
