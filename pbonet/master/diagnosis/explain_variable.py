"""Explains why a variable is too old, or has no value."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.pbo import State

from .cause_chain import Cause, Source
from .event_causes import cause_of
from .explain_task import still
from .key_and_link_verdicts import Level, link_verdict
from .known_causes import REMEDIES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.xm.net import TaskStatus, VarValue

    from .follow_causes import Chain

_NOT_STARTED = "a start opens it, and no task exists"
_SHARE = 0.5
"""An input whose age is passed on has at least this share of the output's age."""


def variable(chain: Chain, name: str) -> tuple[str, list[Cause]]:
    """Return the age of a variable, and why it is so old."""
    facts = chain.facts
    value = facts.values.get(name)
    if value is None:
        return f"the value of {name} could not be read", [*_unread(chain, name)]
    what = _state(chain, value)
    writer = (value.writer or "").rpartition("/")[2]
    constant = any(one.name == name and one.constant for one in facts.graph.variables)
    old = facts.is_old(name) or value.age is None
    status = facts.task(writer)
    goes_on = status is not None and status.state == State.ON
    if not old and (goes_on or constant):
        return what, []
    if not writer:
        return what, list(_unwritten(chain, value, old=old))
    return what, list(_written(chain, value, writer))


def _unread(chain: Chain, name: str) -> Iterator[Cause]:
    """Yield why a variable has no value that could be read."""
    facts = chain.facts
    if facts.keeper in facts.silent:
        yield chain.behind("rtpu", facts.keeper, Source.AGENTS)
    elif facts.closed:
        there = any(rtpu.tasks for rtpu in facts.rtpus.values())
        yield Cause(
            what=f"{facts.closed}, on {facts.keeper}, which keeps it: "
            + ("it was lost, and tasks run without it" if there else _NOT_STARTED),
            source=Source.STATUS,
            remedy=REMEDIES["table lost" if there else "no table"],
        )
    elif facts.from_log:
        yield Cause(
            what=f"the run has no value of {name}: no task that was recorded wrote it",
            source=Source.LOG,
            remedy=REMEDIES["not recorded"],
        )


def _state(chain: Chain, value: VarValue) -> str:
    facts = chain.facts
    limit = facts.limits.get(value.name)
    old = facts.is_old(value.name) or value.age is None
    age = "was never written" if value.age is None else f"is {value.age:.3g} s old"
    if facts.from_log and value.age is not None:
        return f"{value.name} was {value.age:.3g} s old at the end of the run"
    allowed = f", and may be {limit:g} s" if limit is not None else ""
    return f"{value.name} {age}{allowed}: {'stale' if old else 'not stale'}"


def _unwritten(chain: Chain, value: VarValue, *, old: bool) -> Iterator[Cause]:
    """Yield why no task writes a variable."""
    facts = chain.facts
    writers = facts.writers(value.name)
    for task in writers:
        yield chain.behind("task", task, Source.STATUS, REMEDIES["unwritten"])
    for fault in facts.faults_of(variable=value.name):
        remedy = fault.remedy
        what = fault.text.removesuffix(f"; {remedy}") if remedy else fault.text
        yield Cause(what=what, source=Source.FILES, remedy=remedy)
    for event in facts.news(("ILLEGAL",)):
        if value.name in event.text.split() and (event.rtpu in facts.rtpus or old):
            yield cause_of(event, facts)
    if not writers and not facts.faults_of(variable=value.name):
        yield Cause(
            what=f"no task that exists or is planned writes {value.name}",
            source=Source.FILES,
            remedy=REMEDIES["unwritten"],
        )


def _written(chain: Chain, value: VarValue, writer: str) -> Iterator[Cause]:
    """Yield why a variable is old though a task owns it."""
    facts = chain.facts
    status = facts.task(writer)
    if status is None:
        yield chain.behind("task", writer, Source.STATUS)
        return
    if status.state != State.ON:
        yield chain.behind("task", writer, Source.STATUS)
        return
    found = [*_upstream(chain, value, status), *_links(chain, value, writer)]
    found += [] if found else still(chain, status)
    found += [] if found else _slow(chain, value, status)
    if found:
        yield from found
        return
    yield chain.behind("task", writer, Source.STATUS)


def _upstream(chain: Chain, value: VarValue, status: TaskStatus) -> Iterator[Cause]:
    """Yield the inputs of the writer whose age it passes on."""
    facts = chain.facts
    passed = facts.inherited.get(status.task, facts.inputs(status.task))
    least = (value.age or 0.0) * _SHARE
    for name in passed:
        source = facts.values.get(name)
        if source is None or name == value.name:
            continue
        near = source.age is None or source.age >= least
        if near and (facts.is_old(name) or _too_old_for(chain, value, source)):
            first = chain.behind("variable", name, Source.TABLE, REMEDIES["passed on"])
            yield Cause(
                what=f"{status.task} computes it from {name}: ages are passed on",
                source=Source.TABLE,
                because=(first,),
            )


def _too_old_for(chain: Chain, value: VarValue, source: VarValue) -> bool:
    """Return whether an input is older than what is computed from it may be."""
    limit = chain.facts.limits.get(value.name)
    return limit is not None and (source.age is None or source.age > limit)


def _links(chain: Chain, value: VarValue, writer: str) -> Iterator[Cause]:
    """Yield what is wrong with the link that a variable comes through."""
    facts = chain.facts
    names = {
        one.name.rpartition(":")[2]
        for one in facts.graph.links
        if one.task == writer and one.variable == value.name and one.direction == "in"
    }
    seen: set[str] = set()
    for rtpu in facts.rtpus.values():
        for link in rtpu.tbufs:
            if link.name.rpartition(":")[2] not in names or link.name in seen:
                continue
            seen.add(link.name)
            level, text, remedy = link_verdict(link, _link(chain, link.name))
            if level is not Level.PASS:
                yield Cause(what=text, source=Source.STATUS, remedy=remedy)


def _link(chain: Chain, name: str) -> str:
    down = chain.facts.news(("LINK_DOWN", "LINK_MISFIT"))
    told = [event.text for event in down if name in event.text]
    return f"the link {name} brings nothing" + (f": {told[0]}" if told else "")


def _slow(chain: Chain, value: VarValue, status: TaskStatus) -> Iterator[Cause]:
    """Yield that a variable may not be as old as its writer's period."""
    limit = chain.facts.limits.get(value.name)
    if limit is None or not status.ref_f or limit >= 1.0 / status.ref_f:
        return
    yield Cause(
        what=f"{status.task} writes it every {1.0 / status.ref_f:.3g} s, and it may "
        f"be {limit:g} s old",
        source=Source.FILES,
        remedy=REMEDIES["short maxage"],
    )
