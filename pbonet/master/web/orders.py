"""Requests of browsers: read, judged by role, and carried out one after the other.

Commands are those of the command table, and are carried out as the command line's verbs
are: by a living master of the subsystem if there is one. A stop waits for no other
command.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from pbonet.errors import AccessError, PbonetError, ProtocolError, StateError
from pbonet.master.console import (
    Call,
    Reply,
    Scope,
    convert,
    find,
    oneshot,
    read,
    render,
    stop_all,
)

from .access import Role

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from pbonet.master.configuration import Place
    from pbonet.master.console import Command

Data = dict[str, Any]
_SLOW: Final = 0.5
"""Seconds after which a browser is told that its command still runs."""
_MOST_WAITING: Final = 16
"""Commands that may wait."""
_UNFIT: Final = {"quit", "status set", "sigwait"}
"""Commands that concern one interface alone, or would keep others waiting."""


def is_fit(command: Command) -> bool:
    """Return whether a page can give a command."""
    return command.scope is not Scope.PROMPT and command.name not in _UNFIT


class Watch(Struct, tag_field="do", tag="watch", forbid_unknown_fields=True):
    """Variables whose values a browser wants."""

    variables: list[str]


class Order(Struct, tag_field="do", tag="command", forbid_unknown_fields=True):
    """A command of the table, with its arguments by name."""

    id: int
    command: str
    args: dict[str, Any] = {}


class Line(Struct, tag_field="do", tag="line", forbid_unknown_fields=True):
    """A command line as at the prompt."""

    id: int
    line: str


class Stop(Struct, tag_field="do", tag="stop", forbid_unknown_fields=True):
    """Stop every task of the subsystem in order, now."""

    id: int


class Seek(Struct, tag_field="do", tag="seek", forbid_unknown_fields=True):
    """Show a recorded run at a time."""

    t: float
    """Seconds since 1970."""


class Play(Struct, tag_field="do", tag="play", forbid_unknown_fields=True):
    """Let a recorded run go on."""

    speed: float
    """1 as it was; 0 stands still."""


Request = Watch | Order | Line | Stop | Seek | Play
_DECODER: Final[msgspec.json.Decoder[Request]] = msgspec.json.Decoder(Request)


def decode(text: str) -> Request:
    """Return the request in a message.

    Raises:
        ProtocolError: It is none.
    """
    try:
        return _DECODER.decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise ProtocolError(
            "this is no request",
            expected="one of docs/web.md: watch, command, line, stop, seek, play",
            got=str(error)[:200],
            remedy="load the page again; it may be of another version",
        ) from None


def _nothing() -> None:
    """Tell nobody that a command was carried out."""


class Orders:
    """Carries out commands on one subsystem.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        name: The subsystem's name.
        place: Where the subsystem is.
        knows: Tells whether it has a task of a name.
        done: Called when a command was carried out.
    """

    def __init__(
        self,
        path: str | Path,
        name: str,
        place: Place,
        knows: Callable[[str], bool],
        done: Callable[[], None] = _nothing,
    ) -> None:
        self._path = path
        self._name = name
        self._place = place
        self._knows = knows
        self._done = done
        self._one = ThreadPoolExecutor(1, "command")
        self._stops = ThreadPoolExecutor(4, "stop")
        self._waiting = 0

    def close(self) -> None:
        """Carry out nothing more; a command that hangs is abandoned."""
        self._one.shutdown(wait=False, cancel_futures=True)
        self._stops.shutdown(wait=False)

    async def answer(
        self,
        request: Order | Line | Stop,
        role: Role,
        told: Callable[[Data], None],
    ) -> Data:
        """Carry out a request; return the answer for the browser.

        Args:
            request: What it asked for.
            role: What the browser may do.
            told: Called now and then with how it goes, while that takes long.
        """
        try:
            if isinstance(request, Stop):
                return await self._stop(request, role)
            call = self._call(request)
            if call is None:
                return _answer(request.id, ok=True)
            _must_be_allowed(call, role)
            return await self._carry_out(request.id, call, role, told)
        except PbonetError as error:
            return _answer(request.id, ok=False, text=str(error))

    def _call(self, request: Order | Line) -> Call | None:
        if isinstance(request, Line):
            return read(request.line, self._knows)
        command = find(request.command)
        return Call(command, convert(command, request.args))

    async def _carry_out(
        self, number: int, call: Call, role: Role, told: Callable[[Data], None]
    ) -> Data:
        if self._waiting >= _MOST_WAITING:
            raise StateError(
                f"{_MOST_WAITING} commands wait already",
                remedy="wait for their answers; Stop waits for none",
            )
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            work = loop.run_in_executor(self._one, self._perform, call, role)
            async with _progress(number, call.command.name, told):
                reply = await work
        finally:
            self._waiting -= 1
            self._done()
        text = render.text(reply.command, reply.data)
        return _answer(
            number, ok=True, text=text, warnings=reply.warnings, data=reply.data
        )

    def _perform(self, call: Call, role: Role) -> Reply:
        return oneshot.perform(self._path, call, self._place, kind=f"web-{role}")

    async def _stop(self, request: Stop, role: Role) -> Data:
        if role is not Role.OPERATOR:
            raise _only_operators("stop")
        loop = asyncio.get_running_loop()
        try:
            stopped = await loop.run_in_executor(self._stops, self._stop_now)
        finally:
            self._done()
        text = render.text("stop", stopped)
        return _answer(request.id, ok=True, text=text, data=stopped)

    def _stop_now(self) -> Data:
        place = self._place
        return stop_all.stop(self._name, domain=place.domain, connect=place.connect)


def _must_be_allowed(call: Call, role: Role) -> None:
    """Refuse a command that is for another role, or makes no sense on a page.

    Raises:
        AccessError: It changes the subsystem, and the browser is an observer's.
        StateError: It is for another interface.
    """
    command = call.command
    if not is_fit(command):
        raise StateError(
            f"{command.name} is not available here",
            remedy="it is for the prompt and for scripts",
        )
    if call.changes and role is not Role.OPERATOR:
        raise _only_operators(command.name)


def _only_operators(command: str) -> AccessError:
    return AccessError(
        f"{command} changes the subsystem, and this page is an observer's",
        expected="a page that was opened by the operator's link",
        remedy="ask whoever started 'pbonet web' for that link",
    )


@contextlib.asynccontextmanager
async def _progress(
    number: int, name: str, told: Callable[[Data], None]
) -> AsyncIterator[None]:
    """Tell every half second that a command runs, while the block does."""
    begun = time.monotonic()

    async def tell() -> None:
        while True:
            await asyncio.sleep(_SLOW)
            passed = round(time.monotonic() - begun, 1)
            text = f"{name} is being carried out"
            told({"kind": "progress", "id": number, "text": text, "seconds": passed})

    task = asyncio.create_task(tell())
    try:
        yield
    finally:
        task.cancel()


def _answer(
    number: int,
    *,
    ok: bool,
    text: str = "",
    warnings: list[str] | None = None,
    data: Data | None = None,
) -> Data:
    return {
        "kind": "answer",
        "id": number,
        "ok": ok,
        "text": text,
        "warnings": warnings or [],
        "data": data,
    }
