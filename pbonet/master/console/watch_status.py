"""The status of tasks, shown again and again: ``pbonet status --watch``."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import structs

from pbonet.errors import PbonetError, UnknownTaskError
from pbonet.master.subsystem import Subsystem, status_fields

from . import render
from .command_session import Call, CommandSession, convert
from .commands import find
from .live_status import Plain
from .run_end import Interrupts
from .watch_values import Listener

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from typing import Self

    from pbonet.master.configuration import Place
    from pbonet.xm.net import RtpuStatus

    from .live_status import View

_SCREEN, _LINES = 0.5, 5.0
"""Seconds between two tables on a screen, and between two groups of lines."""
_END = "Ctrl-C ends this; the tasks go on"


def watch(
    path: str | Path,
    given: Mapping[str, Any],
    place: Place,
    *,
    every: float | None,
    count: int | None,
    as_data: bool,
) -> None:
    """Show the status of tasks again and again, until interrupted.

    On a terminal the table renews itself, with the last events below it. Elsewhere
    there are lines. RTPUs that do not answer are reported, once each.

    Args:
        path: The subsystem's file.
        given: Arguments of `status`.
        place: Where the subsystem is.
        every: Seconds between; None: as suits the output.
        count: How often; None: until interrupted.
        as_data: Print JSON, one object a line.

    Raises:
        PbonetError: An argument is wrong, or no agent can be reached at the beginning.
        BrokenPipeError: The output is closed.
    """
    call = Call(find("status"), convert(find("status"), given))
    warnings = _Warnings()
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="status",
        watch=True,
        partly=True,
        warned=warnings.add,
    )
    interrupts = Interrupts(once=True)
    with subsystem, interrupts.caught():
        shown = (
            _Lines(subsystem, call) if as_data else _Table(subsystem, call, warnings)
        )
        pause = shown.pause if every is None else every
        begin, done = time.monotonic(), 0
        with shown:
            while not interrupts.wished.is_set():
                shown.show(time.monotonic() - begin)
                done += 1
                if done == count:
                    break
                left = begin + done * pause - time.monotonic()
                interrupts.wished.wait(max(left, 0.0))


class _Warnings:
    """Warnings since the last time, those that were there then left out."""

    def __init__(self) -> None:
        self._before: set[str] = set()
        self._now: list[str] = []

    def add(self, text: str) -> None:
        """Take a warning."""
        self._now.append(text)

    def take(self) -> list[str]:
        """Return the new ones."""
        now = list(dict.fromkeys(self._now))
        new = [text for text in now if text not in self._before]
        self._before = set(now)
        self._now.clear()
        return new


class _Table:
    """The table of a run on a terminal, and lines elsewhere.

    Args:
        subsystem: It is open.
        call: Its arguments say which tasks and fields are shown.
        warnings: Those of the subsystem.
    """

    def __init__(self, subsystem: Subsystem, call: Call, warnings: _Warnings) -> None:
        self._subsystem = subsystem
        self._wanted: list[str] = call.given.get("task") or []
        fields = status_fields.columns([call.given.get("fields") or ""])
        for task in self._wanted:
            subsystem.model.find(task)
        screen = sys.stdout.isatty()
        self.pause = _SCREEN if screen else _LINES
        self._view: View
        if screen:
            from .live_screen import Screen

            self._view = Screen(fields=fields, end=_END)
        else:
            self._view = Plain(fields=fields, period=0)
        self._warnings = warnings
        self._listener = Listener(subsystem)

    def show(self, passed: float) -> None:
        """Renew the table."""
        try:
            rtpus = self._subsystem.rtpu_status()
        except PbonetError as error:  # none answers
            self._warnings.add(str(error))
            rtpus = []
        for text in self._warnings.take():
            self._view.say(render.warning(text))
        events = self._listener.take()
        self._view.show(passed, [self._only(one) for one in rtpus], events)

    def _only(self, rtpu: RtpuStatus) -> RtpuStatus:
        """Return the status of an RTPU with the tasks that are wanted."""
        if not self._wanted:
            return rtpu
        tasks = [task for task in rtpu.tasks if task.task in self._wanted]
        return structs.replace(rtpu, tasks=tasks)

    def __enter__(self) -> Self:
        self._listener.open()
        self._view.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._view.__exit__(*error)
        self._listener.close()


class _Lines:
    """One JSON object a line: what ``pbonet status --json`` prints, with the time."""

    pause = _SCREEN

    def __init__(self, subsystem: Subsystem, call: Call) -> None:
        self._session = CommandSession(subsystem)
        self._call = call

    def show(self, passed: float) -> None:
        """Print a line; what cannot be read now is an error in it."""
        data: dict[str, Any] = {"time": passed}
        try:
            reply = self._session.perform(self._call)
            data |= {**reply.data, "warnings": reply.warnings}
        except PbonetError as error:
            if isinstance(error, UnknownTaskError):
                raise
            data["error"] = error.to_wire()
        sys.stdout.write(f"{msgspec.json.encode(data).decode()}\n")
        sys.stdout.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return
