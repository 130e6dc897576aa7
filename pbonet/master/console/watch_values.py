"""Looking on: values that are shown again and again, events as they happen."""

from __future__ import annotations

import csv
import sys
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import msgspec
import zenoh

from pbonet.errors import Severity
from pbonet.master.subsystem import Subsystem, sequence
from pbonet.xm.net import codec, decoder, direct, key_expressions, messages as m

from . import render
from .command_session import Call, CommandSession, convert
from .commands import find

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from pbonet.master.configuration import Place

Data = dict[str, Any]

_EVENT: Final[msgspec.msgpack.Decoder[m.Event]] = decoder(m.Event)
_KEPT: Final = 1000
OUTPUT: Final = "OUTPUT"
"""Code of an event that is a line which a module printed."""
_LEAST: Final = {
    "errors": Severity.ERROR,
    "warnings": Severity.WARNING,
    "none": None,
}
"""The least severity that is displayed for each ERRPRINT (section 4.5.1)."""


class Listener:
    """Receive the events of a subsystem's RTPUs and keep those to display.

    ERRPRINT of the RTPU selects the events; `least` overrides it.

    Args:
        subsystem: It is open.
        least: The least severity wanted; None: as each RTPU's ERRPRINT says.
        printed: Also receive what modules print.
        heard: Called with each event, in zenoh's thread; it must return at once.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        *,
        least: Severity | None = None,
        printed: bool = False,
        heard: Callable[[m.Event], None] | None = None,
    ) -> None:
        self._subsystem = subsystem
        self._least = least
        self._printed = printed
        self._heard = heard
        self._kept: deque[m.Event] = deque(maxlen=_KEPT)
        self.dropped = 0
        """Events that came faster than they were taken."""
        self._declared: list[zenoh.Subscriber[None]] = []

    def open(self) -> None:
        """Receive events from now on."""
        client = self._subsystem.clients.client
        for rtpu in self._subsystem.clients.names:
            self._declared.append(
                client.session.declare_subscriber(
                    key_expressions.rtpu(client.domain, rtpu, "event"),
                    direct(self._take),
                )
            )

    def close(self) -> None:
        """Stop receiving."""
        for subscriber in self._declared:
            if not self._subsystem.clients.client.session.is_closed():
                subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._declared = []

    def take(self) -> list[m.Event]:
        """Return the events since the last call."""
        found: list[m.Event] = []
        while self._kept:
            found.append(self._kept.popleft())
        return found

    def _take(self, sample: zenoh.Sample) -> None:
        try:
            event = _EVENT.decode(sample.payload.to_bytes())
        except codec.MALFORMED:
            return  # of another version; `events` reports it
        if not self.wants(event):
            return
        self.dropped += len(self._kept) == _KEPT
        self._kept.append(event)
        if self._heard is not None:
            self._heard(event)

    def wants(self, event: m.Event) -> bool:
        """Return whether an event is of the subsystem and is to be displayed."""
        if event.subsystem not in {"", self._subsystem.name}:
            return False
        if self._printed and event.code == OUTPUT:
            return True
        least = self._least
        if least is None:
            entry = self._subsystem.clients.entries.get(event.rtpu)
            least = _LEAST[entry.errprint] if entry else Severity.WARNING
        return least is not None and event.severity >= least


def display(
    path: str | Path,
    given: Mapping[str, object],
    place: Place,
    *,
    form: str,
    every: float,
    count: int | None,
) -> None:
    """Show variables again and again, on standard output, until interrupted.

    Args:
        path: The subsystem's file.
        given: Arguments of `display`.
        place: Where the subsystem is.
        form: ``text``, ``json`` (a line each time) or ``csv``.
        every: Seconds between.
        count: How often; None: until interrupted.

    Raises:
        PbonetError: As `display` says.
    """
    command = find("display")
    call = Call(command, convert(command, given))
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="display",
        watch=True,
    )
    with subsystem:
        session = CommandSession(subsystem)
        show = _FORMS[form]()
        begin = time.monotonic()
        shown, pause = 0, threading.Event()
        while count is None or shown < count:
            show(session.perform(call).data, time.monotonic() - begin)
            shown += 1
            left = begin + shown * every - time.monotonic()
            if left > 0 and shown != count:
                pause.wait(left)


class _Text:
    """The table of `display`, each one over the last on a terminal."""

    def __init__(self) -> None:
        self._clear = "\x1b[H\x1b[2J" if sys.stdout.isatty() else ""

    def __call__(self, data: Data, passed: float) -> None:
        head = self._clear or ("\n" if passed > 0 else "")
        sys.stdout.write(f"{head}{render.text('display', data)}\n")
        sys.stdout.flush()


class _Json:
    """One object a line."""

    def __call__(self, data: Data, passed: float) -> None:
        line = msgspec.json.encode({"time": passed, **data}).decode()
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


class _Csv:
    """One row each time; the head names variable, element and unit."""

    def __init__(self) -> None:
        self._writer = csv.writer(sys.stdout)
        self._columns: dict[str, int] = {}

    def __call__(self, data: Data, passed: float) -> None:
        variables: list[Data] = data["variables"]
        if not self._columns:
            self._columns = {one["name"]: len(_elements(one)) for one in variables}
            self._writer.writerow(_head(variables))
        there = {one["name"]: one for one in variables}
        row: list[object] = [f"{passed:.6f}"]
        for name, count in self._columns.items():
            one = there.get(name)
            if one is None:
                row += [""] * (count + 2)
            else:
                row += [*_elements(one), one["age"], one["writer"] or ""]
        self._writer.writerow(row)
        sys.stdout.flush()


def _elements(variable: Data) -> Sequence[object]:
    return sequence(variable["values"])


def _head(variables: list[Data]) -> list[str]:
    head = ["time (s)"]
    for one in variables:
        name, units = one["name"], one["units"]
        count = len(_elements(one))
        head += [
            f"{name}[{n}] ({units})" if count > 1 else f"{name} ({units})"
            for n in range(count)
        ]
        head += [f"{name} age (s)", f"{name} writer"]
    return head


_FORMS: Final[dict[str, Callable[[], Callable[[Data, float], None]]]] = {
    "csv": _Csv,
    "json": _Json,
    "text": _Text,
}
