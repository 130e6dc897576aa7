"""Explains why a task has missed cycles."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from pbonet.analysis import legality
from pbonet.config import Scheduler

from . import explain_rtpu
from .cause_chain import Cause, Source
from .event_causes import cause_of
from .known_causes import REMEDIES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.xm.net import CoreTrace, CoreUse, Event, TaskStatus

    from .facts import Facts, Gap
    from .follow_causes import Chain

_MOST_USERS = 6
"""Threads that are named as users of a core."""
_NEAR = 0.7
"""Seconds after missed releases until they are reported: twice a second is checked."""
_DELAY = 0.5
"""Share of a period from which on a late start counts as a cause."""


def missed(chain: Chain, task: str, cycle: int = 0) -> tuple[str, list[Cause]]:
    """Return how many cycles a task has missed, and why.

    Args:
        chain: The facts.
        task: The task.
        cycle: The cycle after the missed releases, in a log; 0: all.
    """
    facts = chain.facts
    status = facts.task(task)
    if facts.gaps.get(task) or (cycle and status is not None):
        return _in_log(chain, task, cycle)
    if status is None:
        what, causes = chain.explained("task", task)
        return what, causes
    released = status.cycle + status.miss + status.failed
    what = f"{task} has missed {status.miss} of {released} cycles since it is ON"
    if (trace := facts.trace) is not None and not trace.missed:
        what += f", and none in the {trace.traced:.3g} s in which it was followed"
    if not status.miss and not any(status.failures.values()):
        return what, []
    return what, list(_causes(chain, status))


def _causes(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    yield from _followed(chain, status)
    yield from _itself(chain, status)
    yield from _others(chain, status)
    yield from explain_rtpu.stalls(chain, status)
    yield from _analysis(chain, status)
    yield from _machine(chain, status)


def _followed(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield who had the core when the task missed a release, if that was followed."""
    trace = chain.facts.trace
    if trace is None:
        return
    if trace.fault:
        chain.facts.unknown.append(trace.fault)
    if trace.fault or not trace.missed:
        if trace.times:
            yield Cause(
                what=f"what the kernel counts of {trace.times}", source=Source.KERNEL
            )
        return
    at = f"{time.strftime('%H:%M:%S', time.localtime(trace.wall))}.{_ms(trace.wall)}"
    yield Cause(
        what=f"from its release at {at} on, for {trace.window * 1e3:.4g} ms, it missed "
        f"{_some(trace.missed, 'release')}; who had core {trace.core}: {_users(trace)}",
        source=Source.KERNEL,
        because=(Cause(what=trace.times, source=Source.KERNEL),) if trace.times else (),
        remedy=REMEDIES[_remedy(trace, status)],
    )


def _ms(wall: float) -> str:
    return f"{int(wall % 1 * 1000):03d}"


def _users(trace: CoreTrace) -> str:
    """Return those who had the core, and for how long."""
    found = [
        f"{_user(one)} {one.seconds * 1e3:.3g} ms" for one in trace.uses[:_MOST_USERS]
    ]
    rest = sum(one.seconds for one in trace.uses[_MOST_USERS:])
    return ", ".join(found + [f"others {rest * 1e3:.3g} ms"] * bool(rest)) or "nothing"


def _user(one: CoreUse) -> str:
    if not one.pid:
        return "nobody"
    return one.name if one.known else f"{one.name} (process {one.pid})"


def _remedy(trace: CoreTrace, status: TaskStatus) -> str:
    """Return the remedy for who had the core most of the time."""
    most = next(iter(trace.uses), None)
    if most is None:
        return "late start"
    if not most.pid:
        return "waits"
    if not most.known:
        return "stalled"
    return "too long" if most.name == status.task else "preempted"


def _itself(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield what the task does that takes too long."""
    facts = chain.facts
    period = 1.0 / status.ref_f if status.ref_f else 0.0
    for event in facts.since_on(("HANGS",), status):
        yield cause_of(event, facts, REMEDIES["no cycle"])
    if status.waits:
        yield Cause(what=status.waits, source=Source.STATUS, remedy=REMEDIES["waits"])
    longest = max(status.max_c, status.now_c)
    if period and longest > period:
        yield Cause(
            what=f"its longest cycle takes {longest * 1e3:.3g} ms of CPU time, and its "
            f"period is {period * 1e3:.3g} ms",
            source=Source.SCHEDULE,
            remedy=REMEDIES["too long"],
        )
    elif period and status.first_c > period:
        yield Cause(
            what=f"its first cycle took {status.first_c * 1e3:.3g} ms",
            source=Source.STATUS,
            remedy=REMEDIES["first cycle"],
        )
    kinds = [f"{count} {kind}" for kind, count in status.failures.items() if count]
    if kinds:
        told = facts.since_on(("TIMING_FAILURE",), status)
        yield Cause(
            what=f"timing failures: {', '.join(kinds)}",
            source=Source.STATUS,
            because=tuple(cause_of(one, facts) for one in told),
            remedy="" if longest > period else REMEDIES["overloaded"],
        )


def _others(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield the tasks of the same RTPU that had the core instead."""
    period = 1.0 / status.ref_f if status.ref_f else 0.0
    for other in chain.facts.on_rtpu(status.rtpu):
        if other.task == status.task or other.state != "ON":
            continue
        longest = max(other.max_c, other.now_c)
        scheduler = chain.facts.rtpus[status.rtpu].scheduler
        first = _goes_first(scheduler, other, status)
        if period and first and longest + status.max_c > period:
            muf = scheduler == Scheduler.MUF
            yield Cause(
                what=f"{other.task} {first}, and takes up to {longest * 1e3:.3g} ms",
                source=Source.SCHEDULE,
                remedy=REMEDIES["preempted" if muf else "overloaded"],
            )


def _goes_first(scheduler: str, other: TaskStatus, status: TaskStatus) -> str:
    """Return why another task may have the core first; empty: it may not."""
    if scheduler == Scheduler.RM:
        return "goes first (its rate is higher)" * (other.ref_f > status.ref_f)
    if scheduler == Scheduler.EDF:
        return "goes first when its deadline is earlier"
    if other.crit < status.crit:
        return f"goes first (criticality {other.crit} before {status.crit})"
    same = other.crit == status.crit
    return (
        f"goes first when its deadline is earlier (both criticality {other.crit})"
        * same
    )


def _analysis(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield what the analysis of the RTPU says about the task."""
    for report in chain.facts.reports:
        if report.rtpu != status.rtpu:
            continue
        if status.task in report.unknown:
            yield Cause(
                what=f"no MAXC of {status.task} is known, so nothing bounds it",
                source=Source.SCHEDULE,
                remedy=REMEDIES["unbounded"],
            )
        refused = report.outlook in {
            legality.Outlook.OVERLOADED,
            legality.Outlook.PARTLY,
            legality.Outlook.UNKEPT,
        }
        if refused and status.task not in report.guaranteed:
            yield Cause(
                what=f"RTPU {report.rtpu} is {report.outlook}: utilization "
                f"{report.utilization:.1%}, and {status.task} is not guaranteed",
                source=Source.SCHEDULE,
                remedy=REMEDIES["overloaded"],
            )


def _machine(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield what the machine does to the task."""
    info = chain.facts.agents.get(status.rtpu)
    if info is not None and info.backend != "fifo":
        yield Cause(
            what=f"RTPU {status.rtpu} has no SCHED_FIFO, so timing is soft",
            source=Source.AGENTS,
            remedy=REMEDIES["soft timing"],
        )
    if status.faults > status.cycle and status.cycle:
        yield Cause(
            what=f"{status.faults} page faults since it is ON",
            source=Source.STATUS,
            remedy=REMEDIES["faults"],
        )
    if status.ref_f and status.jitter_max > _DELAY / status.ref_f:
        yield Cause(
            what=f"a cycle began {status.jitter_max * 1e3:.3g} ms after its release",
            source=Source.STATUS,
            remedy=REMEDIES["late start"],
        )


def _in_log(chain: Chain, task: str, cycle: int) -> tuple[str, list[Cause]]:
    """Return the missed cycles of a recorded task, and why."""
    facts = chain.facts
    if cycle and not facts.has_cycle(task, cycle):
        return _not_there(facts, task, cycle), []
    gaps = facts.gaps.get(task, [])
    if cycle:
        gaps = [one for one in gaps if one.cycle == cycle]
    total = sum(one.missed for one in gaps)
    what = f"{task} has missed {_some(total, 'cycle')} in {_some(len(gaps), 'place')}"
    if cycle:
        what = f"{task} has missed {_some(total, 'release')} before cycle {cycle}"
    worst = sorted(gaps, key=lambda one: -one.missed)[:_SHOWN]
    return what, [_gap(chain, task, one) for one in worst]


def _not_there(facts: Facts, task: str, cycle: int) -> str:
    """Return which cycles of a task the log has instead of the one that was asked."""
    what = f"cycle {cycle} of {task} is not in the log, which has"
    numbers = facts.recorded.get(task)
    if not numbers:
        return f"{what} no cycle of it"
    count = _some(sum(map(len, numbers)), "cycle")
    first, last = min(one[0] for one in numbers), max(one[-1] for one in numbers)
    return f"{what} {count} of it, from {first} to {last}"


_SHOWN = 5
_AWAY = 0.2
"""Share of the time in which a task was ready, for dispatching and switches too."""


def _gap(chain: Chain, task: str, gap: Gap) -> Cause:
    """Return the releases missed before one cycle, and what was done meanwhile."""
    facts = chain.facts
    status = facts.task(task)
    period = 1.0 / status.ref_f if status is not None and status.ref_f else 0.0
    because: list[Cause] = []
    if period and gap.longest > period:
        because.append(
            Cause(
                what=f"the cycle before took {gap.longest * 1e3:.3g} ms of CPU time, "
                f"and its period is {period * 1e3:.3g} ms",
                source=Source.LOG,
                remedy=REMEDIES["too long"],
            )
        )
    busy = [one for one in gap.others if period and one[1] > period * _DELAY]
    because += [
        Cause(
            what=f"{other} took {seconds * 1e3:.3g} ms of the core meanwhile",
            source=Source.LOG,
            remedy=REMEDIES["preempted"],
        )
        for other, seconds in busy
    ]
    if gap.away > gap.window * _AWAY:
        because.append(
            Cause(
                what=f"for {gap.away * 1e3:.3g} of the {gap.window * 1e3:.3g} ms in "
                f"which {task} was ready, no task of its RTPU had the core: another "
                "program, the kernel, an interrupt or the hypervisor had it",
                source=Source.LOG,
                remedy=REMEDIES["late start"],
            )
        )
    because += [cause_of(event, facts) for event in _reported(facts, task, gap, period)]
    return Cause(
        what=f"{_some(gap.missed, 'release')} before cycle {gap.cycle}",
        source=Source.LOG,
        because=tuple(because),
        remedy="" if because else REMEDIES["late start"],
    )


def _reported(facts: Facts, task: str, gap: Gap, period: float) -> list[Event]:
    """Return the first event of each code that came with missed releases or after."""
    codes = ("CORE_STALLED", "HANGS", "WAITS", "TIMING_FAILURE", "METHOD")
    until = gap.at + (gap.missed + 1) * period + _NEAR
    newest_first = facts.news(codes, rtpu=facts.home(task), last=len(facts.events))
    found = {
        event.code: event
        for event in newest_first
        if gap.at <= event.wall <= until and event.task in {"", task}
    }
    return list(found.values())


def _some(count: int, what: str) -> str:
    """Return a number of things, in words."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
