"""Gives lost tasks to a new RTPU process again, as `RESTART` of each says.

The requests are those that a master gave, under the same claim, and are judged like a
master's. Nothing is turned on before the keeper's agent has answered, and nothing is
given again of a subsystem that an agent in sight knows to be stopped.
"""

from __future__ import annotations

import itertools
import logging
import queue
import threading
import time
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

import msgspec

from pbonet.config import parse_rmod, parse_svar
from pbonet.errors import ClaimError, NoAnswerError, PbonetError, Severity
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import codec, messages as m, read_result

from .desired_state import ON

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .desired_state import DesiredState, Subsystem

log = logging.getLogger("pbonet.node")

TURN: Final = 1.0
"""Seconds between attempts while something is waited for."""
TRIES: Final = 3
"""Attempts to spawn a task."""
OTHERS_TIME: Final = 10.0
"""Seconds in which the other RTPUs of a subsystem should be seen before the keeper
turns its tasks on without them: one of them may know that it was stopped."""
TIME: Final = 5.0
"""Time limit of requests that have none of their own, in seconds."""
MARGIN: Final = 2.0
"""Seconds by which an answer may exceed the time limit of its request."""
_LOOK: Final = 0.05
CALLED_OFF: Final = "another task or master is in its place since"
"""Why a task that waited stays OFF."""

T = TypeVar("T")


class Peers(Protocol):
    """Asks the other agents, such as `pbonet.xm.net.Client`."""

    def rtpus(self) -> list[str]:
        """Return the names of the RTPUs whose agents are alive."""
        ...

    def masters(self, subsystem: str) -> list[str]:
        """Return the names of the masters of a subsystem that are alive."""
        ...

    def call_all(
        self, requests: Mapping[str, m.Request], result: type[m.AgentInfo]
    ) -> tuple[dict[str, m.AgentInfo], list[PbonetError]]:
        """Return the results by RTPU, and the errors of the others."""
        ...


class Node(Protocol):
    """The agent's own means of carrying out requests."""

    def submit(self, request: m.AnyRequest, reply: Callable[[bytes], None]) -> None:
        """Carry out a request, and pass its packed answer on."""

    def values(self, request: m.Display) -> bytes:
        """Return the packed answer with values of variables."""
        ...


class _OverError(Exception):
    """The RTPU process is lost again, the agent ends, or a stop has come."""


class TaskRestarts:
    """Gives again what was lost with an RTPU process.

    Args:
        name: The RTPU's name.
        state: What is to be there.
        peers: Asks the other agents.
        node: Carries out requests.
        note: Called with reports for masters.
        mark: What the ids of the requests begin with.
    """

    def __init__(
        self,
        name: str,
        state: DesiredState,
        peers: Peers,
        node: Node,
        *,
        note: Callable[[rtpu_messages.Note], None],
        mark: str,
    ) -> None:
        self.name, self.state, self.node = name, state, node
        self._peers, self._note, self._mark = peers, note, mark
        self._count = itertools.count(1)
        self._runs: list[_Run] = []
        self._over = False

    def begin(self, why: str, wait: float = 0.0) -> None:
        """Give everything again that is lost, in a thread.

        Args:
            why: How it was lost, for messages.
            wait: Seconds to wait for the first attempt, after which most is there.
        """
        self.abandon()
        self.state.note_lost(f"{why}; it is being spawned again")
        if not self._over:
            self._runs = [run for run in self._runs if run.thread.is_alive()]
            run = _Run(self, why)
            run.thread.start()
            self._runs.append(run)
            run.tried.wait(wait)

    def abandon(self) -> None:
        """Give nothing more: the RTPU process is lost, or the agent ends."""
        for run in self._runs:
            run.over.set()

    def stop(self) -> None:
        """Wait for the end of what was begun."""
        self._over = True
        self.abandon()
        for run in self._runs:
            run.thread.join()

    def seen(self) -> dict[str, m.AgentInfo]:
        """Return the other agents that answer."""
        names = [name for name in self._peers.rtpus() if name != self.name]
        return self._peers.call_all({name: m.Hello() for name in names}, m.AgentInfo)[0]

    def masters(self, subsystem: str) -> list[str]:
        """Return the masters of a subsystem that are alive."""
        return self._peers.masters(subsystem)

    def next_id(self) -> str:
        """Return the id of a request."""
        return f"{self._mark}{next(self._count)}"

    def say(
        self, severity: Severity, code: str, text: str, subsystem: str, task: str = ""
    ) -> None:
        """Report what comes of a task, or of a subsystem."""
        log.warning("%s/%s: %s", self.name, task or subsystem, text)
        self._note(rtpu_messages.Note(int(severity), code, text, subsystem, task))


class _Run:
    """Giving again what was lost with one RTPU process.

    Args:
        restarts: What it is part of.
        why: How it was lost.
    """

    def __init__(self, restarts: TaskRestarts, why: str) -> None:
        self._all, self._state, self._why = restarts, restarts.state, why
        self._begun = time.monotonic()
        self._tries: dict[tuple[str, str], int] = {}
        self._refused: set[str] = set()
        """Subsystems whose claim was refused."""
        self._paired: set[tuple[str, str]] = set()
        """Standbys for which pairing was tried."""
        self._codec = codec.Codec()
        self.over, self.tried = threading.Event(), threading.Event()
        self.thread = threading.Thread(
            target=self._work, name="pbonet restarts", daemon=True
        )

    def _work(self) -> None:
        left = True
        while left and not self.over.is_set():
            try:
                left = self._turn()
            except _OverError:
                return
            except Exception:  # such as a session that is closing; `status` says so
                log.exception("%s: no task was spawned again now", self._all.name)
            finally:
                self.tried.set()
            self.over.wait(TURN if left else 0.0)

    def _left(self) -> list[str]:
        """Return the subsystems of which something is to be given again."""
        with self._state.guard:
            return [
                name
                for name, kept in self._state.subsystems.items()
                if kept.stages or not (kept.claimed or name in self._refused)
            ]

    def _turn(self) -> bool:
        """Do what can be done now; return whether something is left."""
        left = self._left()
        if not left:
            return False
        infos = self._all.seen()
        for name in left:
            try:
                self._give(name, infos)
            except _OverError:
                if self.over.is_set():
                    raise
        return bool(self._left())

    def _give(self, name: str, infos: Mapping[str, m.AgentInfo]) -> None:
        """Give again what can be given of a subsystem now."""
        if self._is_stopped(name, infos):
            self._state.ended(name)
            text = f"{name} was stopped while this RTPU was away: nothing of it is "
            self._all.say(Severity.WARNING, "NOT_SPAWNED", f"{text}spawned again", name)
            return
        kept = self._state.subsystems.get(name)
        if kept is None or not (kept.claimed or self._claim(name, kept)):
            return
        for task, spawn in kept.spawns().items():
            if kept.stages.get(task) == "lost":
                self._spawn(name, kept, spawn)
        self._pair(name, kept)
        self._turn_on(name, kept, infos)

    def _is_stopped(self, name: str, infos: Mapping[str, m.AgentInfo]) -> bool:
        """Return whether another agent knows of a stop that was not done here."""
        return any(
            stop_id not in self._state.stops and subsystem in {"", name}
            for info in infos.values()
            for stop_id, subsystem in info.due.get(self._all.name, ())
        )

    # -- the steps ---------------------------------------------------------------------

    def _claim(self, name: str, kept: Subsystem) -> bool:
        """Claim the RTPU as before; return whether the subsystem has it."""
        request = msgspec.structs.replace(kept.claim)
        epoch = kept.epoch
        try:
            claimed = self._ask(name, request, m.Claimed)
        except PbonetError as error:
            mine = isinstance(error, ClaimError) and kept.epoch != epoch
            if not mine:  # no other master of the subsystem has claimed it meanwhile
                self._refused.add(name)
                for task in kept.spawns():
                    self._leave_away(name, kept, task, f"not spawned again: {error}")
                return False
        else:
            kept.epoch = claimed.epoch
        kept.claimed = True
        for task in kept.spawns():
            self._bury(name, kept, task)
        for one in kept.of(""):
            try:
                self._ask(name, msgspec.structs.replace(one), object)
            except PbonetError as error:
                log.warning("%s: %s: %s", self._all.name, type(one).__name__, error)
        return True

    def _bury(self, name: str, kept: Subsystem, task: str) -> None:
        """Have a task count as one that has died, until it is spawned again."""
        spawn = kept.spawns()[task]
        request = m.Gone(
            task=task,
            rmod=spawn.rmod,
            rmod_name=spawn.rmod_name,
            error=self._why,
            was_on=task in kept.on,
        )
        try:
            self._ask(name, request, m.TaskStatus, task)
        except PbonetError as error:  # a master has spawned it
            log.debug("%s: %s", task, error)

    def _spawn(self, name: str, kept: Subsystem, spawn: m.Spawn) -> None:
        """Spawn a task as before, unless its constants are not there yet."""
        task = spawn.task
        if spawn.restart == "never":
            self._leave_away(name, kept, task, "not spawned again: RESTART never")
            return
        try:
            if lacking := self._lacking(name, kept, spawn):
                self._wait(kept, task, f"spawned again when {lacking} has a value")
                return
            request = msgspec.structs.replace(spawn, missed=task in kept.on)
            self._ask(name, request, m.TaskStatus, task)
        except PbonetError as error:
            if not self._state.exists(name, task):
                self._bury(name, kept, task)
                self._try_again(name, kept, task, error)
                return
        self._spawned(name, kept, spawn, self._set_up(name, kept, task))

    def _set_up(self, name: str, kept: Subsystem, task: str) -> str:
        """Set what was set since the spawn; return what of it has failed."""
        failed: list[str] = []
        for request in kept.of(task):
            if isinstance(request, m.Spawn | m.Standby):  # standbys: see `_pair`
                continue
            try:
                self._ask(name, msgspec.structs.replace(request), object, task)
            except PbonetError as error:
                failed.append(f"{type(request).__name__.lower()} failed: {error}")
        return "; ".join(failed)

    def _try_again(
        self, name: str, kept: Subsystem, task: str, error: PbonetError
    ) -> None:
        """Note that a task could not be spawned; after some attempts leave it away."""
        tries = self._tries[name, task] = self._tries.get((name, task), 0) + 1
        if tries < TRIES:
            self._wait(kept, task, f"it is tried again: {error}")
        else:
            self._leave_away(name, kept, task, f"not spawned again: {error}")

    def _spawned(self, name: str, kept: Subsystem, spawn: m.Spawn, failed: str) -> None:
        """Decide what comes of a task that is there again."""
        task = spawn.task
        with self._state.guard:
            if task not in kept.stages:
                stopped = task not in kept.spawns()
            elif task in kept.on and not failed and self._comes_on(kept, spawn):
                kept.stages[task] = "waits"
                self._state.changed()
                return
            else:
                stopped = False
                reason = failed or self._why_off(kept, spawn)
                self._stays_off(name, kept, task, reason)
        if stopped:  # while it was being forked; nothing of a stopped subsystem stays
            request = m.Control(task=task, signal="kill")
            self._ask(name, request, object, unless_stopped=False)

    @staticmethod
    def _comes_on(kept: Subsystem, spawn: m.Spawn) -> bool:
        return spawn.restart == "on" and spawn.task not in kept.robots

    @staticmethod
    def _why_off(kept: Subsystem, spawn: m.Spawn) -> str:
        """Return why a task stays OFF."""
        if spawn.task not in kept.on:
            return "as before"
        if spawn.restart == "on":
            return "a robot interface never comes ON unasked"
        return f"RESTART {spawn.restart}"

    def _pair(self, name: str, kept: Subsystem) -> None:
        """Have standbys stand by again, as soon as both tasks are there."""
        for request in kept.requests:
            if (
                not isinstance(request, m.Standby)
                or (name, request.task) in self._paired
            ):
                continue
            both = {request.task, request.original} - {""}
            if all(self._state.exists(name, task) for task in both):
                self._paired.add((name, request.task))
                try:
                    self._ask(name, msgspec.structs.replace(request), object)
                except PbonetError as error:
                    text = f"it does not stand by for {request.original} again: {error}"
                    self._all.say(
                        Severity.ERROR, "NOT_SPAWNED", text, name, request.task
                    )

    def _turn_on(
        self, name: str, kept: Subsystem, infos: Mapping[str, m.AgentInfo]
    ) -> None:
        """Turn on what waits for that, if the keeper has answered."""
        waiting = [task for task, stage in kept.stages.items() if stage == "waits"]
        waiting.sort(key=lambda task: kept.on.index(task) if task in kept.on else -1)
        later = waiting and self._not_yet(name, kept, infos)
        if waiting and {*self._all.masters(name)} - {kept.claim.client}:
            with self._state.guard:  # it may be starting a job, and has not come to us
                kept.stay_off(waiting)
        for task in waiting:
            if task not in kept.on:
                self._stays_off(name, kept, task, CALLED_OFF)
                continue
            if later:
                self._wait(kept, task, f"spawned again, comes ON when {later}")
                continue
            there = [r for r, info in infos.items() if task in info.on.get(name, ())]
            reason = f"it is ON on {there[0]}" if there else self._on(name, task)
            if reason:
                self._stays_off(name, kept, task, reason)
            else:
                text = f"{self._why}; spawned again, and ON again: RESTART on"
                self._all.say(Severity.INFO, "RESTARTED", text, name, task)
                with self._state.guard:
                    kept.clear(task)
                self._state.changed()

    def _on(self, name: str, task: str) -> str:
        """Turn a task on; return why it is not ON."""
        request = m.Control(task=task, signal="on", timeout=TIME)
        try:
            status = self._ask(name, request, m.TaskStatus, task)
        except PbonetError as error:
            return str(error)
        if status.state == ON:
            return ""
        return f"state {status.state}: {status.error or 'its module is not ready'}"

    def _not_yet(
        self, name: str, kept: Subsystem, infos: Mapping[str, m.AgentInfo]
    ) -> str:
        """Return what must come before tasks are turned on; empty: nothing."""
        keeper = kept.claim.keeper
        if keeper not in {"", self._all.name}:
            info = infos.get(keeper)
            if info is None:
                return f"the keeper {keeper} answers"
            again = f"the keeper {keeper} has {name} again"
            return "" if name in info.claims else again
        others = [one for one in kept.others if one not in infos]
        late = time.monotonic() > self._begun + OTHERS_TIME
        return f"{' and '.join(others)} answers" if others and not late else ""

    def _lacking(self, name: str, kept: Subsystem, spawn: m.Spawn) -> str:
        """Return the constants of a task that have no value yet, as text."""
        rmod = parse_rmod(spawn.rmod, spawn.rmod_name)
        table = parse_svar(kept.claim.svar, kept.claim.svar_name)
        given = {one.name for one in table.variables if one.init is not None}
        names = {rmod.svar_name(port) for port in rmod.inconst} - given
        if not names:
            return ""
        request = m.Display(subsystem=name, names=sorted(names))
        answer = self._codec.answer(self._all.node.values(request))
        values = read_result(self._all.name, answer, list[m.VarValue])
        return " and ".join(one.name for one in values if one.age is None)

    # -- reports -----------------------------------------------------------------------

    def _wait(self, kept: Subsystem, task: str, text: str) -> None:
        with self._state.guard:
            if task in kept.stages:
                kept.notes[task] = f"{self._why}; {text}"

    def _leave_away(self, name: str, kept: Subsystem, task: str, reason: str) -> None:
        """Give up a task, and tell why."""
        text = f"{self._why}; {reason}"
        with self._state.guard:
            if task not in kept.stages:
                return
            kept.drop(task)
            kept.notes[task] = text
        self._state.changed()
        self._all.say(Severity.ERROR, "NOT_SPAWNED", text, name, task)

    def _stays_off(self, name: str, kept: Subsystem, task: str, reason: str) -> None:
        """Leave a task that is there again OFF, and tell why."""
        text = f"{self._why}; spawned again, OFF: {reason}"
        with self._state.guard:
            if task not in kept.stages:
                return
            was_on = task in kept.on
            del kept.stages[task]
            kept.on = [one for one in kept.on if one != task]
            kept.notes[task] = text
        self._state.changed()
        severity = Severity.WARNING if was_on else Severity.INFO
        self._all.say(severity, "RESTARTED", text, name, task)

    # -- requests ----------------------------------------------------------------------

    def _ask(
        self,
        name: str,
        request: m.AnyRequest,
        result: type[T],
        task: str = "",
        *,
        unless_stopped: bool = True,
    ) -> T:
        """Carry out a request as if a master had made it; return its result.

        Args:
            name: The subsystem.
            request: The request.
            result: The type of its result.
            task: A task that must not be given up, or stopped, in the meantime.
            unless_stopped: Whether the subsystem must still be there.

        Raises:
            _OverError: Nothing more is to be given.
            PbonetError: It was refused, or has failed.
        """
        answered: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        with self._state.guard:
            kept = self._state.subsystems.get(name)
            gone = kept is None or (task and task not in kept.stages)
            if kept and isinstance(request, m.Control) and request.signal == "on":
                gone = gone or task not in kept.on
            if self.over.is_set() or kept is None or (gone and unless_stopped):
                raise _OverError
            request.id, request.subsystem = self._all.next_id(), name
            request.epoch = kept.epoch
            if not isinstance(request, m.Claim):
                request.client = f"{self._all.name}-restarts"
            self._all.node.submit(request, answered.put)
        limit = getattr(request, "timeout", TIME)
        if isinstance(request, m.Spawn | m.Control):
            limit *= 1.0 + m.MOST_EXTRA
        limit += MARGIN
        answer = self._codec.answer(self._receive(answered, limit))
        return read_result(self._all.name, answer, result)

    def _receive(self, answered: queue.SimpleQueue[bytes], limit: float) -> bytes:
        deadline = time.monotonic() + limit
        while time.monotonic() < deadline:
            try:
                data = answered.get(timeout=_LOOK)
            except queue.Empty:
                data = b""
            if self.over.is_set():
                raise _OverError
            if data:
                return data
        raise NoAnswerError(
            f"the RTPU process did not answer within {limit:g} s",
            where=self._all.name,
            remedy="see its events",
        )
