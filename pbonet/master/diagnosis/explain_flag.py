"""Explains why the illegal-configuration flag is up (Stewart 1994, section 3.10)."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from .cause_chain import Cause, Source
from .event_causes import cause_of, clock
from .known_causes import OWN_TEXT, REMEDIES, flag_cause

if TYPE_CHECKING:
    from pbonet.xm.net import Event

    from .follow_causes import Chain

_RAISED = re.compile(r"(.*) \((\S+)\)", re.DOTALL)


def flag(chain: Chain) -> tuple[str, list[Cause]]:
    """Return whether the flag is up, and each of its causes with their own causes."""
    facts = chain.facts
    raised: dict[str, list[str]] = {}
    for name, status in facts.rtpus.items():
        for cause in status.illegal:
            raised.setdefault(cause, []).append(name)
    if not raised:
        silent = [chain.behind("rtpu", one, Source.AGENTS) for one in facts.silent]
        return _no_cause(chain), silent
    what = f"the flag of {facts.subsystem} {'was' if facts.from_log else 'is'} up"
    if len(raised) > 1:
        what += f" for {len(raised)} causes"
    return what, [_cause(chain, one, at) for one, at in raised.items()]


def _no_cause(chain: Chain) -> str:
    """Return what is known of a flag that no RTPU which answers has raised."""
    facts = chain.facts
    flag_of = f"the flag of {facts.subsystem}"
    if facts.from_log:
        return f"{flag_of} was not up in this run"
    if not facts.rtpus:
        return f"whether {flag_of} is up is not known"
    if facts.silent:
        return f"{flag_of} is down on {', '.join(facts.rtpus)}"
    return f"{flag_of} is down"


def _cause(chain: Chain, text: str, rtpus: list[str]) -> Cause:
    """Return one cause of the flag, with what it leads to."""
    if span := chain.facts.withdrawn.get(text):
        return _past(text, rtpus, span)
    found = _RAISED.fullmatch(text)
    sentence, raiser = (found[1], found[2]) if found else (text, "")
    kind, subject = flag_cause(sentence)
    because: list[Cause] = []
    remedy = OWN_TEXT
    if kind is None:
        because = _events_of(chain, raiser)
    else:
        because = _behind(chain, kind.subject, subject, raiser)
        remedy = kind.remedy
    return Cause(
        what=f"{text}, on {', '.join(rtpus)}",
        source=Source.LOG if chain.facts.from_log else Source.STATUS,
        because=tuple(because),
        remedy=remedy,
    )


def _past(text: str, rtpus: list[str], span: tuple[Event, Event]) -> Cause:
    """Return a cause of a recorded run that was withdrawn before its end.

    What is known of the end does not explain it.
    """
    first, last = (clock(one.wall) for one in span)
    return Cause(
        what=f"{text}, on {', '.join(rtpus)}, between {first} and {last}, not later",
        source=Source.LOG,
        remedy=REMEDIES["withdrawn"],
    )


def _behind(chain: Chain, kind: str, subject: str, raiser: str) -> list[Cause]:
    facts = chain.facts
    if kind == "host":
        hosts = {name: one.host for name, one in facts.agents.items()}
        named = [name for name, host in hosts.items() if host == subject]
        return [
            chain.behind("rtpu", one, Source.AGENTS)
            for one in [*named, *(set(facts.silent) - set(named))]
        ]
    if kind:
        source = Source.TABLE if kind == "variable" else Source.STATUS
        return [chain.behind(kind, subject, source)]
    rtpu, _, _ = raiser.partition("/")
    return [chain.behind("rtpu", rtpu, Source.AGENTS)] if rtpu in facts.silent else []


def _events_of(chain: Chain, raiser: str) -> list[Cause]:
    """Return the last event of a module that has raised the flag itself."""
    task = raiser.rpartition("/")[2]
    told = chain.facts.news(("WARNING", "SIGNAL", "METHOD"), task=task)
    return [cause_of(one, chain.facts) for one in told] if task else []
