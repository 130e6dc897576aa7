"""Events as they happen, without omissions: ``pbonet events --follow``.

Publications only wake this program; the events themselves are requested by their
numbers, so a sample that the network drops, or an agent that is restarted, loses
nothing.
"""

from __future__ import annotations

import select
import sys
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pbonet.errors import UnknownTaskError
from pbonet.master.subsystem import EventFilter, Subsystem, since
from pbonet.xm.net import messages as m

from . import render
from .run_end import Interrupts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from pbonet.master.configuration import Place

LOOK_TIME: Final = 0.5
"""Seconds after which events are asked for though none was announced."""
_LAST: Final = 20


class Follower:
    """Hands out the events of a subsystem's RTPUs, each one once.

    Args:
        subsystem: It is open.
        wanted: Which events.
    """

    def __init__(self, subsystem: Subsystem, wanted: EventFilter) -> None:
        self._subsystem = subsystem
        self._wanted = wanted
        self._next: dict[str, int] = {}
        self._time: dict[str, int] = {}
        self._silent: dict[str, str] = {}
        """RTPUs that do not answer, and why; each is reported once."""
        self.left_out = 0
        """Events that an RTPU had forgotten before they could be asked for."""
        self.doubt: str | None = None
        """Warnings about the filter, judged by the first events that were taken."""

    def take(self) -> list[m.Event]:
        """Return what has happened since the last call, the oldest first."""
        found: list[m.Event] = []
        left = list(self._subsystem.clients.names)
        while left:
            left = self._round(left, found)
        if self.doubt is None:
            self.doubt = self._wanted.doubt(found) or self._no_task(found)
        mine = {"", self._subsystem.name}
        chosen = [e for e in found if e.subsystem in mine and self._wanted(e)]
        return sorted(chosen, key=lambda event: (event.wall, event.n))

    def _no_task(self, found: Iterable[m.Event]) -> str:
        """Return a warning of a task that neither is there nor has events."""
        task = self._wanted.task
        if task is not None and not any(event.task == task for event in found):
            try:
                self._subsystem.task_set.locate(task)
            except UnknownTaskError as error:
                return str(error)
        return ""

    def complaints(self) -> dict[str, str]:
        """Return the RTPUs that do not answer now, and why."""
        return dict(self._silent)

    def _round(self, rtpus: list[str], found: list[m.Event]) -> list[str]:
        """Ask RTPUs at once, and return those that may have more events.

        The event before the first one is requested too: an RTPU that has another one
        under its number, or none, is another process.

        Args:
            rtpus: Which.
            found: Takes the events.
        """
        results, errors = self._subsystem.clients.each(
            lambda rtpu: m.Events(since=max(self._next.get(rtpu, 0) - 1, 0)),
            list[m.Event],
            rtpus=rtpus,
        )
        silent = [rtpu for rtpu in rtpus if rtpu not in results]
        self._silent |= dict(zip(silent, map(str, errors), strict=True))
        left: list[str] = []
        for rtpu, events in results.items():
            self._silent.pop(rtpu, None)
            new = self._new(rtpu, events)
            if new is None:
                self._next[rtpu] = 0
                left.append(rtpu)
            elif new:
                found += new
                left.append(rtpu)
        return left

    def _new(self, rtpu: str, events: list[m.Event]) -> list[m.Event] | None:
        """Return the new ones of an RTPU's events; None: it is another process.

        Events that it has forgotten before they could be asked for are counted.
        """
        since = self._next.get(rtpu, 0)
        if since > 1:
            if not events:
                return None
            if events[0].n == since - 1:
                if events[0].time != self._time[rtpu]:
                    return None
                events = events[1:]
        if events:
            if since > 1 and events[0].n > since:
                self.left_out += events[0].n - since
            self._next[rtpu] = events[-1].n + 1
            self._time[rtpu] = events[-1].time
        return events


def _kept_here(_: m.Event) -> None:
    """Send an event nowhere else."""


def follow(
    path: str | Path,
    given: Mapping[str, Any],
    place: Place,
    *,
    as_data: bool,
    also: Callable[[m.Event], None] = _kept_here,
) -> None:
    """Print the last events and then each new one, until interrupted.

    Args:
        path: The subsystem's file.
        given: Arguments of `events`.
        place: Where the subsystem is.
        as_data: Print JSON, one object a line.
        also: Called with each event that is printed.

    Raises:
        PbonetError: An argument is wrong, or no agent can be reached.
        BrokenPipeError: The output is closed.
    """
    wanted = EventFilter.of(given)
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="events",
        watch=True,
        partly=True,
    )
    # A KeyboardInterrupt may be swallowed where Python ignores what a callback raises.
    interrupts = Interrupts(once=True)
    with subsystem, subsystem.news() as news, interrupts.caught():
        follower = Follower(subsystem, wanted)
        last = given.get("last")
        first, _ = since(given.get("since") or 0)
        events = [event for event in follower.take() if event.n >= first]
        if follower.doubt:
            render.print_error(render.warning(follower.doubt))
        count = _LAST if last is None else last
        _show(events[max(0, len(events) - count) :], also, as_data=as_data)
        told: dict[str, str] = {}
        while not interrupts.wished.is_set():
            _must_be_read()
            news.wait(LOOK_TIME)
            news.clear()
            _show(follower.take(), also, as_data=as_data)
            told = _complain(told, follower)
    raise KeyboardInterrupt


def _must_be_read() -> None:
    """Raise when the reader of a pipe is gone, which else the next event would show."""
    if not hasattr(select, "poll"):  # not on every system that a master runs on
        return
    ends = select.poll()
    ends.register(sys.stdout.fileno(), 0)
    if any(what & select.POLLERR for _, what in ends.poll(0)):
        raise BrokenPipeError


def _complain(told: dict[str, str], follower: Follower) -> dict[str, str]:
    """Report RTPUs that do not answer, and missing events."""
    now = follower.complaints()
    for rtpu in now.keys() - told.keys():
        render.print_error(render.warning(now[rtpu]))
    for rtpu in told.keys() - now.keys():
        render.print_error(render.warning(f"{rtpu} answers again"))
    if follower.left_out:
        text = f"{follower.left_out} events came faster than they could be read"
        render.print_error(render.warning(f"{text}; 'events --count' has them counted"))
        follower.left_out = 0
    return now


def _show(
    events: Iterable[m.Event], also: Callable[[m.Event], None], *, as_data: bool
) -> None:
    for event in events:
        also(event)
        text = render.event(event)
        data = msgspec.json.encode(event).decode() if as_data else text
        sys.stdout.write(f"{data}\n")
    sys.stdout.flush()
