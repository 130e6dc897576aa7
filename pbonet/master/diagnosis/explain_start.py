"""Explains why a job would not start, or did not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import PbonetError
from pbonet.xm.net import messages as m

from .cause_chain import Cause, Source
from .event_causes import cause_of
from .known_causes import REMEDIES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .follow_causes import Chain

_FAILED = ("SPAWN_FAILED", "NOT_SPAWNED", "SIGNAL_FAILED")


def start(chain: Chain, job: str) -> tuple[str, list[Cause]]:
    """Return whether a job would be refused now, and why."""
    facts = chain.facts
    planned = facts.planned.job if facts.planned is not None else ""
    name = job or planned or facts.subsystem
    refused = [*_refused(chain), *_reach(chain), *_others(chain)]
    failed = [*_failed(chain)]
    if facts.from_log:
        return f"the start of {name} in this run", failed
    what = f"the start of {name} would {'be' if refused else 'not be'} refused now"
    if failed and not refused:
        what += ", and something failed at the last one"
    return what, [*refused, *failed]


def _refused(chain: Chain) -> Iterator[Cause]:
    """Yield the faults for which verification refuses; RTPUs that are away follow."""
    away = {str(PbonetError.from_wire(one)) for one in chain.facts.silent.values()}
    for fault in chain.facts.start:
        first, *places = fault.text.splitlines()
        if {
            one.removeprefix("|-- ").removeprefix("`-- ") for one in places or [first]
        } <= away:
            continue
        remedy = fault.remedy
        what = fault.text.removesuffix(f"; {remedy}") if remedy else fault.text
        yield Cause(what=what, source=Source.FILES, remedy=remedy)


def _reach(chain: Chain) -> Iterator[Cause]:
    """Yield the RTPUs that a start needs and that do not answer."""
    for name in chain.facts.silent:
        yield chain.behind("rtpu", name, Source.AGENTS)
    for text in chain.facts.held:
        yield Cause(what=text, source=Source.AGENTS, remedy=m.HELD_REMEDY)


def _others(chain: Chain) -> Iterator[Cause]:
    """Yield who else has the subsystem or its RTPUs."""
    facts = chain.facts
    if facts.masters:
        yield Cause(
            what=f"the master {', '.join(facts.masters)} has the subsystem",
            source=Source.AGENTS,
            remedy=REMEDIES["another master"],
        )
    for name, info in facts.agents.items():
        others = sorted(info.claims.keys() - {facts.subsystem})
        if name in facts.shared:
            facts.unknown += [f"whether {one} shares RTPU {name}" for one in others]
        elif others:
            yield Cause(
                what=f"{', '.join(others)} uses RTPU {name}, which is to be exclusive",
                source=Source.AGENTS,
                remedy="use a free RTPU, or `USAGE shared` in both `.sbs` files",
            )


def _failed(chain: Chain) -> Iterator[Cause]:
    """Yield what failed at the last start, if nothing was spawned since."""
    facts = chain.facts
    for event in facts.news((*_FAILED, "SPAWNED")):
        if event.code != "SPAWNED":
            yield cause_of(event, facts)
