"""Explains why an RTPU does not answer, or does not do what it should."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import PbonetError
from pbonet.pbo import State
from pbonet.versions import REMEDY
from pbonet.xm.net import messages as m, unreachable_reason

from .cause_chain import Cause, Source
from .event_causes import cause_of
from .key_and_link_verdicts import Level, keys_of
from .known_causes import REMEDIES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.errors import WireError
    from pbonet.xm.net import TaskStatus

    from .follow_causes import Chain

_PROCESS = ("RTPU_DIED", "AGENT_GONE", "DISPATCHER_ENDED", "FORK_SERVER_DIED")


def rtpu(chain: Chain, name: str) -> tuple[str, list[Cause]]:
    """Return how an RTPU is, and why."""
    facts = chain.facts
    if (error := facts.silent.get(name)) is not None:
        return f"RTPU {name} does not answer", _silent(chain, name, error)
    if name not in facts.rtpus:
        return f"nothing is known of RTPU {name}", []
    if facts.from_log:
        had = f"RTPU {name} was used in this run, {_tasks(chain, name)}"
        return had, [*_inside(chain, name)]
    causes = [*_machine(chain, name), *_inside(chain, name)]
    return f"RTPU {name} answers, {_tasks(chain, name)}", causes


def _inside(chain: Chain, name: str) -> Iterator[Cause]:
    """Yield what is wrong with its process, its core and its tasks."""
    yield from _process(chain, name)
    yield from _core(chain, name)
    for status in chain.facts.on_rtpu(name):
        if status.state == State.ERROR:
            yield chain.behind("task", status.task, Source.STATUS)


def _tasks(chain: Chain, name: str) -> str:
    there = chain.facts.on_rtpu(name)
    return f"with {len(there)} tasks" if len(there) != 1 else "with 1 task"


def _silent(chain: Chain, name: str, wire: WireError) -> list[Cause]:
    error = PbonetError.from_wire(wire)
    remedy = wire.get("remedy", "")
    error.remedy = ""
    found = [Cause(what=str(error), source=Source.AGENTS, remedy=remedy)]
    loss = unreachable_reason.first(name, chain.facts.agents.values())
    if loss is not None and loss[1].rtpu not in str(error):
        what = unreachable_reason.loss(*loss)
        advice = unreachable_reason.remedy(*loss)
        found.append(Cause(what=what, source=Source.AGENTS, remedy=advice))
    return found


def _machine(chain: Chain, name: str) -> Iterator[Cause]:
    """Yield what is wrong with its agent."""
    facts = chain.facts
    for text in facts.held:
        if text.startswith(f"{name} of "):
            yield Cause(what=text, source=Source.AGENTS, remedy=m.HELD_REMEDY)
    for text in facts.tables:
        if f"{name} of " in text:
            yield Cause(what=text, source=Source.AGENTS, remedy=REMEDY)
    info = facts.agents.get(name)
    if info is None:
        return
    if info.keys_left is not None:
        keys = keys_of(info, info.keys_left)
        if keys.level is not Level.PASS:
            yield Cause(what=keys.what, source=Source.AGENTS, remedy=keys.remedy)
    yield from (Cause(what=one, source=Source.AGENTS) for one in info.limits)


def _process(chain: Chain, name: str) -> Iterator[Cause]:
    """Yield the ends of its process, and what it lacks."""
    facts = chain.facts
    for event in facts.news(_PROCESS, rtpu=name):
        yield cause_of(event, facts, REMEDIES["restarted"])
    status = facts.rtpus[name]
    if not (status.scheduler or status.tasks or facts.from_log):
        yield Cause(
            what="no master uses it",
            source=Source.STATUS,
            because=tuple(
                cause_of(one, facts) for one in facts.news(("STOPPED",), rtpu=name)
            ),
            remedy=REMEDIES["unclaimed"],
        )
    for event in facts.news(("TABLE_DAMAGED", "TABLE_BEHIND"), rtpu=name):
        yield cause_of(event, facts)


def _core(chain: Chain, name: str) -> Iterator[Cause]:
    """Yield why its core was not there for its tasks."""
    facts = chain.facts
    status = facts.rtpus[name]
    if status.stalls:
        newest = facts.news(("CORE_STALLED",), rtpu=name)
        times = "once" if status.stalls == 1 else f"{status.stalls} times"
        yield Cause(
            what=f"its core stood still {times}, {status.stalled:.3g} s in all",
            source=Source.STATUS,
            because=tuple(cause_of(one, facts) for one in newest),
            remedy=REMEDIES["stalled"],
        )
    for event in facts.news(("CALLS_REFUSED", "SCHEDULING_CHANGED"), rtpu=name):
        yield cause_of(event, facts)


def stalls(chain: Chain, status: TaskStatus) -> list[Cause]:
    """Return the stalls of a core as causes, if there was one since a task is ON."""
    newest = chain.facts.news(("CORE_STALLED",), rtpu=status.rtpu)
    if newest and newest[0].time < status.on_ns and not chain.facts.from_log:
        return []
    return [*_core(chain, status.rtpu)]
