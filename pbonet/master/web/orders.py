"""Requests of browsers: read, judged by role, and carried out one after the other.

Commands are those of the command table, and are carried out as the command line's verbs
are: by a living master of the subsystem if there is one. A stop waits for no other
command.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec import Struct

from pbonet.config import Library
from pbonet.errors import (
    AccessError,
    NodeError,
    PbonetError,
    ProtocolError,
    StateError,
)
from pbonet.master import diagnosis
from pbonet.master.console import (
    COMMANDS,
    Call,
    Kind,
    Scope,
    convert,
    find,
    oneshot,
    read,
    render,
    stop_all,
)
from pbonet.master.subsystem import sequence

from .access import Role
from .job_edits import JobEdits
from .programs import STEERING, Programs

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence
    from pathlib import Path

    from pbonet.master.configuration import Place
    from pbonet.master.console import Command
    from pbonet.master.subsystem import Subsystem

log = logging.getLogger("pbonet.master")

Data = dict[str, Any]
_SLOW: Final = 0.5
"""Seconds after which a browser hears that its command still runs."""
_END_TIME: Final = 30.0
"""Seconds that a command which is carried out from here has when the server ends."""
_OTHERS_END_TIME: Final = 3.0
"""Seconds that are waited for one that another master carries out."""
_PAUSE: Final = 0.05
MOST_WAITING: Final = 16
"""Commands that may wait."""
_UNFIT: Final = {"quit", "status set", "sigwait"}
"""Commands that concern one interface alone, or would keep others waiting."""
_LEAVES: Final = {"stop", "profile save"}
"""Commands that need no claim, and are no observer's: they end tasks, write files."""


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


class Edit(Struct, tag_field="do", tag="edit", forbid_unknown_fields=True):
    """Change the job that is edited, or ask something about it; see `JobEdits`."""

    id: int
    edit: str
    args: dict[str, Any] = {}


class Program(Struct, tag_field="do", tag="program", forbid_unknown_fields=True):
    """Do something with a program of jobs; see `Programs`."""

    id: int
    program: str
    args: dict[str, Any] = {}


class Seek(Struct, tag_field="do", tag="seek", forbid_unknown_fields=True):
    """Show a recorded run at a time."""

    t: float
    """Seconds since 1970."""


class Play(Struct, tag_field="do", tag="play", forbid_unknown_fields=True):
    """Let a recorded run go on."""

    speed: float
    """1 as it was; 0 stands still."""


Wish = Order | Line | Stop | Edit | Program
"""Requests that are answered."""
Request = Watch | Order | Line | Stop | Edit | Program | Seek | Play
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
            expected="watch, command, line, stop, edit, program, seek or play",
            got=str(error)[:200],
            remedy="load the page again; it may be of another version",
        ) from None


def _nothing() -> None:
    """Take no note that a command was carried out."""


def _unheard(_: Data) -> None:
    """Tell no browser."""


class Done(NamedTuple):
    """The outcome of a request."""

    text: str = ""
    warnings: Sequence[str] = ()
    data: Data | None = None


class Steered(NamedTuple):
    """The subsystem that a page steers."""

    path: str | Path
    """The ``.sbs`` file, or a ``.job`` or ``.seq`` file that names it."""
    name: str
    place: Place
    """Where it is."""


class _Work(NamedTuple):
    """The work that a request asks for."""

    name: str
    do: Callable[[], Done]
    pool: ThreadPoolExecutor
    """The threads that do it."""
    starts: bool = False
    """Whether it may start something; then a stop is the end of it."""


class Orders:
    """Carries out what browsers ask for: commands, edits of jobs, programs, stops.

    Args:
        steered: The subsystem.
        knows: Tells whether it has a task of a name.
        done: Called when a command was carried out.
        told: Called with messages for all browsers: states of the editor and of the
            program that runs.
    """

    def __init__(
        self,
        steered: Steered,
        knows: Callable[[str], bool],
        done: Callable[[], None] = _nothing,
        told: Callable[[Data], None] = _unheard,
    ) -> None:
        self._steered = steered
        self._knows = knows
        self._done = done
        path, place = steered.path, steered.place
        self._edits = JobEdits(path, Library(place.libraries), told)
        self._programs = Programs(path, place, Library(place.libraries), told)
        self._commands = ThreadPoolExecutor(1, "command")
        self._looks = ThreadPoolExecutor(1, "look")
        self._files = ThreadPoolExecutor(1, "files")
        self._simulating = ThreadPoolExecutor(1, "simulating")
        self._steering = ThreadPoolExecutor(1, "steering")
        self._stops = ThreadPoolExecutor(4, "stop")
        self._pools = (
            self._commands, self._looks, self._files, self._simulating, self._steering,
            self._stops,
        )  # fmt: skip
        self._waiting = dict.fromkeys(self._pools, 0)
        self._stopped = 0
        """Stops that were carried out."""
        self._changing: Subsystem | None = None
        """The subsystem of the command that changes it now."""
        self._doing: dict[int, str] = {}
        """The names of what is being done, by thread."""

    def close(self) -> None:
        """Carry out nothing more, and wait some seconds for what is being done.

        A command that waits for conditions gives up, and a simulation ends. One that
        changes the subsystem from here is given longer than one that another master
        carries out, which goes on without this server.
        """
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)
        begun = time.monotonic()
        while self._doing:
            self._edits.cancel()
            changing = self._changing
            if changing is not None:
                changing.stopped.set()  # it may just have begun, which clears it
            limit = _OTHERS_END_TIME if changing is None else _END_TIME
            if time.monotonic() - begun > limit:
                break
            time.sleep(_PAUSE)
        self._programs.close()

    @property
    def commands(self) -> Sequence[Command]:
        """The commands that a page can give."""
        return list(filter(is_fit, COMMANDS))

    @property
    def left(self) -> list[str]:
        """Sentences about what is still being carried out."""
        names = list(self._doing.values())
        own = self._changing is not None
        where = "from here: it is cut off" if own else "elsewhere: it goes on there"
        return [f"{name} was still being carried out {where}" for name in names]

    def first(self) -> list[Data]:
        """Return the messages for a new browser about the program that runs."""
        state = self._programs.state
        return [state] if state else []

    async def answer(
        self, request: Wish, role: Role, told: Callable[[Data], None]
    ) -> Data:
        """Do what a browser asks for; return the answer for it.

        Args:
            request: What it asked for.
            role: What the browser may do.
            told: Called now and then with how it goes, while that takes long.
        """
        number = request.id
        try:
            work = self._work(request, role)
            if work is None:
                return answered(number, Done())
            return answered(number, await self._carry_out(number, work, told))
        except PbonetError as error:
            return refusal(number, str(error))
        except Exception as error:  # noqa: BLE001 - or the browser waits in vain
            return failure(number, error)

    def _work(self, request: Wish, role: Role) -> _Work | None:
        """Return what a request asks for; None: nothing.

        Raises:
            PbonetError: It is refused.
        """
        if isinstance(request, Line | Order):
            call = self._call(request)
            if call is None:
                return None
            _must_be_allowed(call, role)
            if call.command.name == "stop":
                return _Work("stop", self._stop, self._stops)
            perform = partial(self._perform, call, role)
            looks = role is not Role.OPERATOR or call.command.name == "explain"
            pool = self._looks if looks else self._commands
            return _Work(call.command.name, perform, pool, starts=call.changes)
        if role is not Role.OPERATOR:
            raise _only_operators(str(request.__struct_config__.tag))
        if isinstance(request, Stop):
            return _Work("stop", self._stop, self._stops)
        if isinstance(request, Edit):
            return self._edit(request)
        program = partial(self._programs.do, request.program, request.args)
        pool = self._steering if request.program in STEERING else self._files
        starts = request.program == "run"
        return _Work(request.program, lambda: Done(data=program()), pool, starts=starts)

    def _edit(self, request: Edit) -> _Work:
        """Return the work of an edit; a simulation keeps no edits waiting."""
        if request.edit == "simulate":
            simulate = partial(self._simulate, request.args)
            return _Work("simulate", simulate, self._simulating)
        if request.edit == "cancel":
            return _Work("cancel", self._cancel, self._steering)

        def edit() -> Done:
            data = self._edits.do(request.edit, request.args)
            data.pop("state", None)  # it was sent to all browsers
            return Done(data=data)

        return _Work(request.edit, edit, self._files)

    def _call(self, request: Order | Line) -> Call | None:
        if isinstance(request, Line):
            return read(request.line, self._knows)
        command = find(request.command)
        return Call(command, convert(command, request.args))

    async def _carry_out(
        self, number: int, work: _Work, told: Callable[[Data], None]
    ) -> Done:
        if self._waiting[work.pool] >= MOST_WAITING:
            raise StateError(
                f"{MOST_WAITING} commands wait already",
                remedy="wait for their answers; Stop waits for none",
            )
        self._waiting[work.pool] += 1
        try:
            loop = asyncio.get_running_loop()
            do = partial(self._do, work, self._stopped)
            doing = loop.run_in_executor(work.pool, do)
            async with progress(number, work.name, told):
                return await doing
        finally:
            self._waiting[work.pool] -= 1
            self._done()

    def _do(self, work: _Work, stopped: int) -> Done:
        """Do what was asked for, unless a stop has come since: it was meant before.

        Raises:
            PbonetError: It is refused, or failed.
        """
        if work.starts and self._stopped != stopped:
            raise StateError(
                f"a stop came before {work.name} was carried out; it was left out",
                remedy="give it again",
            )
        me = threading.get_ident()
        self._doing[me] = work.name
        try:
            return work.do()
        finally:
            del self._doing[me]

    def _perform(self, call: Call, role: Role) -> Done:
        path, place = self._steered.path, self._steered.place
        if call.command.name == "explain":  # also with all RTPUs away
            words, trace = call.given.get("what") or (), call.given.get("trace") or 0.0
            found = diagnosis.answer(path, words, place, trace=trace)
            return Done(str(found), data=msgspec.to_builtins(found))

        def begun(subsystem: Subsystem) -> None:
            if call.changes:
                self._changing = subsystem

        try:
            reply = oneshot.perform(path, call, place, kind=f"web-{role}", begun=begun)
        finally:
            if call.changes:
                self._changing = None
        text = render.text(reply.command, reply.data)
        return Done(text, reply.warnings, reply.data)

    def _simulate(self, args: Data) -> Done:
        """Run the job that is edited in virtual time; edits go on meanwhile."""
        prepared = self._files.submit(self._edits.simulation, args).result()
        return Done(data=prepared())

    def _cancel(self) -> Done:
        self._edits.cancel()
        return Done()

    def _stop(self) -> Done:
        self._stopped += 1
        if (changing := self._changing) is not None:
            changing.stopped.set()
        name, place = self._steered.name, self._steered.place
        data = stop_all.stop(name, domain=place.domain, connect=place.connect)
        return Done(render.text("stop", data), data=data)


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
    if role is Role.OPERATOR:
        return
    if _leaves_traces(call):
        raise _only_operators(command.name)
    if any("/" in word for word in _files(call)):
        raise AccessError(
            "an observer's page names no files elsewhere, whose modules would be run",
            expected="the name of a job or of an RMOD beside the subsystem's file",
            remedy="ask whoever started 'pbonet web' for the operator's link",
        )


def _files(call: Call) -> list[str]:
    """Return the jobs and the RMODs that a command names, or may name."""
    kinds = {Kind.JOB, Kind.RMOD, Kind.QUESTION}
    named = [arg for arg in call.command.args if arg.kind in kinds]
    values = [call.given.get(arg.name) or "" for arg in named]
    return [str(word) for value in values for word in sequence(value)]


def _leaves_traces(call: Call) -> bool:
    """Return whether something is otherwise during or after a command."""
    named = call.command.name in _LEAVES
    more = call.given.get("reset") or call.given.get("trace")
    return call.changes or named or bool(more)


def _only_operators(command: str) -> AccessError:
    return AccessError(
        f"{command} changes the subsystem, and this page is an observer's",
        expected="a page that was opened by the operator's link",
        remedy="ask whoever started 'pbonet web' for that link",
    )


@contextlib.asynccontextmanager
async def progress(
    number: int, name: str, told: Callable[[Data], None]
) -> AsyncGenerator[None]:
    """Tell every half second that a command runs, while the block does."""
    begun = time.monotonic()

    async def report() -> None:
        while True:
            await asyncio.sleep(_SLOW)
            passed = round(time.monotonic() - begun, 1)
            text = f"{name} is being carried out"
            told({"kind": "progress", "id": number, "text": text, "seconds": passed})

    task = asyncio.create_task(report())
    try:
        yield
    finally:
        task.cancel()


def refusal(number: int, text: str) -> Data:
    """Return the answer to a request that was not carried out."""
    return answered(number, Done(text), ok=False)


def failure(number: int, error: Exception) -> Data:
    """Log an error that pbonet itself made; return the answer to that request."""
    log.error("a request of a browser failed inside pbonet", exc_info=error)
    failed = NodeError(
        f"it failed inside pbonet: {type(error).__name__}: {error}",
        remedy="see the output of 'pbonet web', and report it",
    )
    return refusal(number, str(failed))


def answered(number: int, done: Done, *, ok: bool = True) -> Data:
    """Return the answer to a request."""
    return {
        "kind": "answer",
        "id": number,
        "ok": ok,
        "text": done.text,
        "warnings": list(done.warnings),
        "data": done.data,
    }
