"""Explains why a task is in its state, or does not do its work though it is ON."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pbonet.master.configuration import next_steps
from pbonet.pbo import State
from pbonet.xm.net import event_codes

from .cause_chain import Cause, Source
from .event_causes import cause_of, sentence
from .known_causes import REMEDIES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.xm.net import Event, TaskStatus

    from .follow_causes import Chain

_ENDS = ("TASK_DIED", "FORCED", "TABLE_DAMAGED")
_FAILS = ("METHOD", "SIGNAL_FAILED")
_MOVES = ("STATE", "SPAWNED", "ENGAGED", "RESTARTED", "SIGNAL_FAILED", "STOPPED")
_PERIODS = 2.0
"""A task whose cycles go on has counted one within so many periods."""
_TOO_OLD = re.compile(r"the input (\S+) is too old")


def task(chain: Chain, name: str) -> tuple[str, list[Cause]]:
    """Return the state of a task, and why it is in it."""
    status = chain.facts.task(name)
    if status is None:
        return _absent(chain, name)
    what = f"task {name} on {status.rtpu} is {status.state}"
    told = {State.ERROR: _error, State.NOT_CREATED: _ended, State.OFF: _off}
    find = told.get(State(status.state), _on)
    return what, list(find(chain, status))


def _absent(chain: Chain, name: str) -> tuple[str, list[Cause]]:
    """Explain a task that no RTPU which answers has."""
    facts = chain.facts
    home = facts.home(name)
    where = f" on {home}" if home else ""
    if home in facts.silent:
        cause = chain.behind("rtpu", home, Source.AGENTS)
        return f"the state of task {name}{where} is not known", [cause]
    found: list[Cause] = []
    lost = facts.news(("NOT_SPAWNED", "SPAWN_FAILED", "SPAWNED"), task=name)
    if lost and lost[0].code != "SPAWNED":
        found.append(cause_of(lost[0], facts, REMEDIES["not spawned"]))
    elif missing := next((one for one in facts.missing if one.task == name), None):
        found.append(
            Cause(
                what=missing.reason,
                source=Source.STATUS,
                remedy=REMEDIES["not spawned"],
            )
        )
    ends = [
        *facts.news(_ENDS, task=name),
        *(facts.news(("STOPPED",), rtpu=home) if home else ()),
    ]
    if ends:  # an older one did not end what was spawned after it
        found.append(cause_of(max(ends, key=lambda event: event.wall), facts))
    found += _of_last_process(chain, name, "LEFT_SAFE")
    return f"task {name}{where} is {State.NOT_CREATED}", found


def _of_last_process(chain: Chain, name: str, code: str) -> Iterator[Cause]:
    """Yield the newest event of a code, if it is about a task's last process."""
    for event in chain.facts.news((code, "SPAWNED"), task=name):
        if event.code == code:
            yield cause_of(event, chain.facts)


def _error(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield why a task is in ERROR."""
    facts = chain.facts
    newest = facts.news(_FAILS, task=status.task)
    because = [cause_of(one, facts) for one in newest]
    if old := _TOO_OLD.search(status.error):
        because.append(chain.behind("variable", old[1], Source.TABLE))
    yield Cause(
        what=status.error or (sentence(newest[0]) if newest else "no error is known"),
        source=Source.STATUS,
        because=tuple(because),
        remedy=next_steps(State.ERROR, status.task),
    )


def _ended(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield why a task whose status is kept has no process."""
    facts = chain.facts
    last = facts.news(_ENDS, task=status.task)
    ends = [cause_of(one, facts) for one in last]
    if last and last[0].code == "FORCED":
        ends += _of_last_process(chain, status.task, "HANGS")
    again = facts.news(("NOT_SPAWNED",), task=status.task)
    ends += [cause_of(one, facts) for one in again]
    ends += _of_last_process(chain, status.task, "LEFT_SAFE")
    yield Cause(
        what=status.error or "its process has ended",
        source=Source.STATUS,
        because=tuple(ends),
        remedy=REMEDIES["died"],
    )
    if status.restarted:
        yield Cause(what=status.restarted, source=Source.STATUS)


def _off(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield why a task is OFF."""
    facts = chain.facts
    if status.restarted:
        ends = facts.news(("RTPU_DIED", "AGENT_GONE"), rtpu=status.rtpu)
        yield Cause(
            what=status.restarted,
            source=Source.STATUS,
            because=tuple(cause_of(one, facts) for one in ends),
            remedy=REMEDIES["turned off"],
        )
        return
    if status.stands_by:
        yield Cause(
            what=f"it stands by for {status.fallback_of}",
            source=Source.STATUS,
            remedy=REMEDIES["stands by"],
        )
        return
    newest = facts.news(_MOVES, task=status.task)
    if not newest:
        what = "it was turned off before the events that the RTPU has kept"
        never = "it was not turned on since it was spawned"
        yield Cause(
            what=what if status.on_ns else never,
            source=Source.STATUS,
            remedy=REMEDIES["turned off" if status.on_ns else "never on"],
        )
        return
    yield _moved(chain, status, newest[0])


def _moved(chain: Chain, status: TaskStatus, event: Event) -> Cause:
    """Return the last change of a task's state as the cause that it is OFF."""
    facts = chain.facts
    if event.code == "SPAWNED":
        return cause_of(event, facts, REMEDIES["never on"])
    if event.code == "SIGNAL_FAILED":
        return cause_of(event, facts, next_steps(State.OFF, status.task))
    ordered = event.text in {event_codes.TURNED_OFF, event_codes.CLEARED}
    key = "turned off" if ordered else "off by itself"
    told = facts.news(("SIGNAL", "TIMING_FAILURE", "METHOD"), task=status.task)
    near = [one for one in told if abs(one.wall - event.wall) <= 1.0]
    near = [] if ordered else near  # what happened then is not why it was ordered
    cause = cause_of(event, facts, REMEDIES[key])
    return Cause(
        what=cause.what,
        source=cause.source,
        because=tuple(cause_of(one, facts) for one in near),
        remedy=cause.remedy,
    )


def _on(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield why a task that is ON does not do its work."""
    facts = chain.facts
    for name in facts.inputs(status.task):
        value = facts.values.get(name)
        if value is not None and facts.is_old(name):
            yield chain.behind("variable", name, Source.TABLE)
    stands = [*still(chain, status)] if status.ref_f else []
    yield from stands
    for event in facts.since_on(("HANGS",), status) if not stands else ():
        yield cause_of(event, facts)
    if status.failed:
        told = facts.since_on(("METHOD", "HANDLED"), status)
        yield Cause(
            what=f"{status.failed} of its cycles failed",
            source=Source.LOG if facts.from_log else Source.STATUS,
            because=tuple(cause_of(one, facts) for one in told),
            remedy=REMEDIES["cycles fail"],
        )
    if status.waits:
        yield Cause(what=status.waits, source=Source.STATUS, remedy=REMEDIES["waits"])
    if status.miss:
        yield chain.behind("miss", status.task, Source.STATUS)
    if status.warning:
        yield Cause(what=f"it warns: {status.warning}", source=Source.STATUS)


def still(chain: Chain, status: TaskStatus) -> Iterator[Cause]:
    """Yield that the writer's cycles do not go on."""
    facts = chain.facts
    later = facts.later.get(status.task)
    if later is None or later != status.cycle:
        return
    if status.ref_f and facts.watched * status.ref_f < _PERIODS:
        return
    hangs = facts.news(("HANGS", "WAITS"), task=status.task)
    yield Cause(
        what=f"{status.task} is ON, and its cycle count stands still at {status.cycle}",
        source=Source.STATUS,
        because=tuple(cause_of(one, facts) for one in hangs),
        remedy=REMEDIES["no cycle"],
    )
