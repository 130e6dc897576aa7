"""Events as causes."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from .cause_chain import Cause, Source

if TYPE_CHECKING:
    from pbonet.xm.net import Event

    from .facts import Facts


def cause_of(event: Event, facts: Facts, remedy: str = "") -> Cause:
    """Return an event as a cause.

    Args:
        event: The event.
        facts: Those that it belongs to.
        remedy: What to do about it.
    """
    source = Source.LOG if facts.from_log else Source.EVENTS
    return Cause(what=sentence(event), source=source, remedy=remedy)


def sentence(event: Event) -> str:
    """Return when an event was, of what, and its text."""
    where = f", cycle {event.cycle}" if event.cycle else ""
    place = f" ({event.place})" if event.place else ""
    whose = "/".join(filter(None, (event.rtpu, event.task)))
    return f"{event.code} of {whose} at {clock(event.wall)}{where}: {event.text}{place}"


def clock(wall: float) -> str:
    """Return the time of day of seconds since 1970."""
    return time.strftime("%H:%M:%S", time.localtime(wall))
