"""Requests to agents, with the errors and time limits that zenoh does not give.

A zenoh query without an answer ends without a reply and without an error, whether there
is no server, the server died with the query, or access control dropped it. This layer
finds out which it was: it reads the liveliness tokens, asks again with the same request
id (an agent executes an id once), and gives up within the time limit of the request.
During a long request the agent is monitored by greetings: if it does not answer one,
the request is given up after little more than a second, not at the end of its limit.

Replaces the message queues between the master task and the SBS servers of Stewart
1994, section 4.5.
"""

from __future__ import annotations

import contextlib
import contextvars
import itertools
import os
import threading
import time
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

import msgspec
import zenoh

from pbonet import versions
from pbonet.errors import (
    AccessError,
    NoAnswerError,
    PbonetError,
    ProtocolError,
    SeveralError,
    UnreachableError,
)
from pbonet.lazy import logger
from pbonet.versions import LAYERS

from . import key_expressions, roles, run_folder, unreachable_reason
from .agents import AgentInfo
from .callbacks import direct
from .codec import Codec
from .deliveries import Deliveries
from .messages import Answer, Hello, Request, Stop
from .relay_messages import read_result

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

T = TypeVar("T")

ANSWER_TIME: Final = 2.0
"""Seconds in which a live agent answers any request."""

WAY_TIME: Final = 0.5
"""Seconds for both directions, in addition to the time limit of a request."""
ASK_TIME: Final = 0.5
"""Seconds without an answer after which an agent is sent a greeting."""
PROOF_TIME: Final = 0.6
"""Seconds in which a live agent answers the greeting."""
_SLICE: Final = 0.05
"""The wait for that answer is divided into slices of this many seconds. If the whole
machine stalls, client and agent alike, that counts as one slice only."""
_SILENCE_TIME: Final = 1.0
"""Seconds for which an agent that did not answer a greeting is not asked again; a stop
is always sent."""
_ALONE_TIME: Final = 1.2
"""If no agent at all can be reached, the agent through which we reach the others has
ended; zenoh connects to the next one within this time. The same wait applies to an
agent that is not seen while its process runs here: its link is being restored."""
_LOSS_TIME: Final = 0.3
"""Seconds in which agents report which others they have lost, for all together."""
_LEAST_TRIES: Final = 10
"""Minimum number of attempts to find an agent: after a stall of the whole machine all
times have passed while links are still being restored."""
_TOKEN_TIME: Final = 1.0
_RETRY_PAUSE: Final = 0.05
_REPLIES: Final = 8
"""Room for the replies to a query: one, unless two agents have the same name."""
_TOKENS: Final = 10_000  # zenoh's default channel deadlocks above 256 tokens


def log_warning(rtpu: str, text: str) -> None:
    """Log a warning that came with an answer."""
    logger("pbonet.xm").info("%s: %s", rtpu, text)


def log_failure(text: str) -> None:
    """Log what was not delivered."""
    logger("pbonet.xm").warning("%s", text)


class _Waiter:
    """Collects the replies of one query; runs in zenoh's receiving thread."""

    def __init__(self) -> None:
        self.reply: zenoh.Reply | None = None
        self.done = threading.Event()

    def take(self, reply: zenoh.Reply) -> None:
        if self.reply is None:
            self.reply = reply
            self.done.set()  # there is one answer; zenoh reports the end later

    def end(self) -> None:
        self.done.set()


class Declared(Protocol):
    """Something declared in zenoh."""

    def undeclare(self) -> None:
        """Withdraw the declaration."""


class Client:
    """Sends requests to the agents of one domain for one master or tool.

    Args:
        session: An open zenoh session that reaches at least one agent.
        domain: The domain of the RTPUs.
        name: The client's own unique name, as in its liveliness token.
        warned: Called with an RTPU's name and a warning that came with an answer.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: str,
        name: str,
        *,
        warned: Callable[[str, str], None] = log_warning,
    ) -> None:
        self.session = session
        self.domain = domain
        self.name = name
        self.warned = warned
        self._codec = Codec()
        self._run = os.urandom(4).hex()
        self._count = itertools.count(1)
        self._deliveries: Deliveries | None = None
        self._silent: dict[str, float] = {}
        """Time at which an RTPU's agent did not answer a greeting."""
        self._spoken: dict[str, int] = {}
        """The version of commands that an RTPU's agent has understood."""

    def tokens(self, key: str) -> list[str]:
        """Return the keys of the liveliness tokens that match `key`, sorted."""
        try:
            replies = self.session.liveliness().get(
                key, zenoh.handlers.FifoChannel(_TOKENS), timeout=_TOKEN_TIME
            )
            found = {str(reply.ok.key_expr) for reply in replies if reply.ok}
        except zenoh.ZError as error:
            raise no_session(error) from None
        return sorted(found)

    def rtpus(self) -> list[str]:
        """Return the names of the RTPUs whose agents are alive, sorted."""
        return sorted(map(key_expressions.rtpu_name, self.tokens(self._alive("*"))))

    def masters(self, subsystem: str) -> list[str]:
        """Return the names of the masters of a subsystem that are alive, sorted."""
        tokens = self.tokens(key_expressions.masters(self.domain, subsystem))
        return sorted(key_expressions.master_of(token)[1] for token in tokens)

    def call(
        self,
        rtpu: str,
        request: Request,
        result: type[T],
        *,
        timeout: float = ANSWER_TIME,
    ) -> T:
        """Send `request` to an RTPU and return its result as `result`.

        Args:
            rtpu: The RTPU's name.
            request: The request; its id and client are filled in here.
            result: The type of the result; `NoneType` for none.
            timeout: Time limit of the operation itself in seconds. The answer may come
                half a second later; an agent that does not answer greetings is given
                up after `ASK_TIME` and `PROOF_TIME`.

        Raises:
            UnreachableError: No agent of that name is alive.
            NoAnswerError: The agent is alive and did not answer in time.
            PbonetError: The agent refused; the error has the class that it names.
        """
        request.id = f"{self._run}-{next(self._count)}"
        request.client = request.client or self.name
        request.v = self._spoken.get(rtpu, LAYERS["commands"].newest)
        answer = self._exchange(rtpu, request, timeout)
        for text in answer.warnings:
            self.warned(rtpu, text)
        if not answer.ok:
            raise _refusal(rtpu, answer)
        return read_result(rtpu, answer, result)

    def post(self, rtpu: str, request: Request) -> None:
        """Send a request without waiting for an answer.

        Raises:
            UnreachableError: The connection to the agents is closed.
        """
        request.id = f"{self._run}-{next(self._count)}"
        request.client = request.client or self.name
        request.v = self._spoken.get(rtpu, LAYERS["commands"].newest)
        payload = self._codec.pack(request)
        self._get(rtpu, roles.leaf(request), payload, ANSWER_TIME)

    def deliver(self, rtpu: str, request: Request) -> None:
        """Send a request after those delivered before it, and return at once.

        A failure is a warning in the log of "pbonet.xm".
        """
        if self._deliveries is None:
            self._deliveries = Deliveries(self, log_failure)
        self._deliveries.add(rtpu, request)

    def call_all(
        self,
        requests: Mapping[str, Request],
        result: type[T],
        *,
        timeout: float = ANSWER_TIME,
    ) -> tuple[dict[str, T], list[PbonetError]]:
        """Send a request to each of several RTPUs at once.

        Returns:
            The results by RTPU, and the errors of the others.
        """
        if not requests:
            return {}, []
        results: dict[str, T] = {}
        failed: dict[str, Exception] = {}

        def ask(rtpu: str) -> None:
            try:
                results[rtpu] = self.call(rtpu, requests[rtpu], result, timeout=timeout)
            except Exception as error:  # noqa: BLE001 - raised below
                failed[rtpu] = error

        *others, last = requests  # this thread handles the last one
        threads = [
            # in this context, so that warnings find their command
            threading.Thread(target=contextvars.copy_context().run, args=(ask, rtpu))
            for rtpu in others
        ]
        for thread in threads:
            thread.start()
        ask(last)
        for thread in threads:
            thread.join()
        errors: list[PbonetError] = []
        for error in (failed[rtpu] for rtpu in requests if rtpu in failed):
            if not isinstance(error, PbonetError):
                raise error
            errors.append(error)
        return {rtpu: results[rtpu] for rtpu in requests if rtpu in results}, errors

    def announce(self, key: str) -> Declared:
        """Declare a liveliness token until the returned object is undeclared.

        Raises:
            UnreachableError: The connection to the agents is closed.
        """
        try:
            token: Declared = self.session.liveliness().declare_token(key)
        except zenoh.ZError as error:
            raise no_session(error) from None
        return token

    def subscribe(self, key: str, told: Callable[[], None]) -> Declared:
        """Call a function, in zenoh's thread, for each sample under a key."""

        def on_sample(_: zenoh.Sample) -> None:
            told()

        subscriber: zenoh.Subscriber[None] = self.session.declare_subscriber(
            key, direct(on_sample)
        )
        return subscriber

    def close(self) -> None:
        """Close the session; a waiting call ends with an error."""
        if self._deliveries is not None:
            self._deliveries.end()
        if not self.session.is_closed():
            self.session.close()  # type: ignore[no-untyped-call]

    def _alive(self, rtpu: str) -> str:
        return key_expressions.rtpu(self.domain, rtpu, "alive")

    def _exchange(self, rtpu: str, request: Request, timeout: float) -> Answer:
        """Return the agent's answer; ask again while it is alive and silent."""
        if self._is_silent(rtpu) and not isinstance(request, Stop):
            raise self._no_sign(rtpu)
        payload = self._codec.pack(request)
        leaf, greeted = roles.leaf(request), False
        end = time.monotonic() + timeout + WAY_TIME
        give_up = time.monotonic() + ANSWER_TIME
        alone = time.monotonic() + _ALONE_TIME
        for tries in itertools.count(1):
            reply = self._ask(rtpu, leaf, payload, end)
            if reply is not None and reply.ok is not None:
                return self._answer(rtpu, request, reply.ok.payload.to_bytes(), timeout)
            if reply is not None:  # zenoh's own time-out
                raise _no_answer(rtpu, timeout)
            names = self.rtpus()
            now = time.monotonic()
            patient = tries <= _LEAST_TRIES
            if rtpu not in names and not (
                self._may_come_back(rtpu, names) and (patient or now <= alone)
            ):
                raise unreachable_reason.unreachable(
                    rtpu, self.domain, names, self._loss(rtpu, names)
                )
            if greeted:  # it answered the greeting, but not this request
                raise _no_access(rtpu)
            greeted = leaf != "status" and rtpu in names and self._hello(rtpu)
            if now > min(give_up, end) and not patient:
                break
            time.sleep(
                _RETRY_PAUSE
            )  # it is starting, or our own link is being restored
        raise _no_answer(rtpu, ANSWER_TIME)

    def _agree(self, rtpu: str, refused: int) -> int:
        """Return the version to speak with an agent, after it has refused another one.

        Raises:
            ProtocolError: There is none.
        """
        hello = Hello(v=refused, id=f"{self._run}-{next(self._count)}")
        hello.client = self.name
        answer = self._exchange(rtpu, hello, ANSWER_TIME)  # it takes any version
        mine = LAYERS["commands"]
        theirs = read_result(rtpu, answer, AgentInfo).understands("commands")
        found = versions.common(mine, theirs)
        if found is None or found == refused:
            raise ProtocolError(
                "the agent speaks another protocol version: only hello and stop work",
                where=rtpu,
                expected=str(mine),
                got=str(theirs),
                remedy=versions.REMEDY,
            )
        self._spoken[rtpu] = found
        return found

    def _is_silent(self, rtpu: str) -> bool:
        """Return whether an agent has just failed to answer a greeting."""
        return time.monotonic() - self._silent.get(rtpu, -_SILENCE_TIME) < _SILENCE_TIME

    def _ask(
        self, rtpu: str, leaf: str, payload: bytes, end: float
    ) -> zenoh.Reply | None:
        """Return the reply to a query; None if it ended without one.

        Most answers come soon. For those a channel is used, which costs a quarter of a
        round trip less than a callback that wakes us. A longer request is sent again,
        which is harmless, and monitored.
        """
        soon = min(ASK_TIME, end - time.monotonic())
        reply = self._at_once(rtpu, leaf, payload, soon)
        if reply is None or reply.ok is not None:
            return reply
        waiter = self._get(rtpu, leaf, payload, end - time.monotonic())
        while True:
            if self._is_stopped(rtpu) or not self._hello(rtpu, waiter):
                if rtpu not in self.rtpus():
                    return None
                self._silent[rtpu] = time.monotonic()
                raise self._no_sign(rtpu)
            if waiter.done.wait(ASK_TIME) or time.monotonic() >= end:
                return waiter.reply

    def _at_once(
        self, rtpu: str, leaf: str, payload: bytes, timeout: float
    ) -> zenoh.Reply | None:
        """Return the first reply, or zenoh's own at the time limit."""
        try:
            replies = self.session.get(
                key_expressions.rtpu(self.domain, rtpu, leaf),
                zenoh.handlers.FifoChannel(_REPLIES),
                payload=payload,
                timeout=max(timeout, 0.1),
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        except zenoh.ZError as error:
            raise no_session(error) from None
        return next(iter(replies), None)

    def _get(self, rtpu: str, leaf: str, payload: bytes, timeout: float) -> _Waiter:
        waiter = _Waiter()
        try:
            self.session.get(
                key_expressions.rtpu(self.domain, rtpu, leaf),
                direct(waiter.take, waiter.end),
                payload=payload,
                timeout=max(timeout, 0.1),
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        except zenoh.ZError as error:
            raise no_session(error) from None
        return waiter

    def _hello(self, rtpu: str, other: _Waiter | None = None) -> bool:
        """Return whether the agent answers a greeting, or the other request."""
        hello = Hello(id=f"{self._run}-{next(self._count)}", client=self.name)
        payload = self._codec.pack(hello)
        waiter = self._get(rtpu, roles.leaf(hello), payload, ANSWER_TIME)
        for _ in range(round(PROOF_TIME / _SLICE)):
            if waiter.done.wait(_SLICE) or (other and other.done.is_set()):
                break
        answered = waiter.reply is not None and waiter.reply.ok is not None
        return answered or (other is not None and other.done.is_set())

    def _may_come_back(self, rtpu: str, names: list[str]) -> bool:
        """Return whether links to all agents, or to one that runs here, may return.

        Args:
            rtpu: The RTPU of the agent.
            names: The RTPUs that are seen, without this one.
        """
        pid = run_folder.agent_processes(self.domain).get(rtpu, 0)
        return not names or (pid > 0 and not run_folder.is_stopped(pid))

    def _is_stopped(self, rtpu: str) -> bool:
        """Return whether an agent's process runs here and is stopped."""
        pid = run_folder.agent_processes(self.domain).get(rtpu, 0)
        return pid > 0 and run_folder.is_stopped(pid)

    def _no_sign(self, rtpu: str) -> PbonetError:
        """Return the error for an agent that does not answer, though its link stands.

        Agents keep a link during an interruption, and know that it is one.
        """
        names = [name for name in self.rtpus() if name != rtpu]
        stopped = self._is_stopped(rtpu)
        loss = ("", "") if stopped else self._loss(rtpu, names)
        if stopped or loss[0]:
            return unreachable_reason.unreachable(rtpu, self.domain, names, loss)
        return _no_sign(rtpu)

    def _loss(self, rtpu: str, names: list[str]) -> tuple[str, str]:
        """Return which agent has lost this one, and the remedy; empty if unknown."""
        infos: list[AgentInfo] = []
        end = time.monotonic() + _LOSS_TIME
        for name in names:
            left = end - time.monotonic()
            if left <= 0 or self._is_silent(name):
                continue
            hello = Hello(id=f"{self._run}-{next(self._count)}", client=self.name)
            payload, leaf = self._codec.pack(hello), roles.leaf(hello)
            with contextlib.suppress(PbonetError, msgspec.ValidationError):
                reply = self._at_once(name, leaf, payload, left)
                if reply is not None and reply.ok is not None:
                    answer = self._codec.answer(reply.ok.payload.to_bytes())
                    infos.append(read_result(name, answer, AgentInfo))
        if (found := unreachable_reason.first(rtpu, infos)) is None:
            return "", ""
        by, lost = found
        return unreachable_reason.loss(by, lost), unreachable_reason.remedy(by, lost)

    def _answer(
        self, rtpu: str, request: Request, data: bytes, timeout: float
    ) -> Answer:
        """Return the answer in `data`; if its version was refused, that to another."""
        if self._codec.version(data) != request.v:
            request.v = self._agree(rtpu, request.v)
            return self._exchange(rtpu, request, timeout)
        answer = self._codec.answer(data)
        if answer.id != request.id:
            raise ProtocolError(
                "the answer belongs to another request",
                where=rtpu,
                expected=request.id,
                got=answer.id or "no id",
                remedy="run the same pbonet version on every machine",
            )
        return answer


def raise_all(what: str, errors: list[PbonetError], *, remedy: str = "") -> None:
    """Raise nothing, the one error, or all errors as one tree."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise SeveralError(what, errors, remedy=remedy)


def _no_answer(rtpu: str, seconds: float) -> NoAnswerError:
    return NoAnswerError(
        f"the agent is alive but did not answer within {seconds:g} s",
        where=rtpu,
        remedy=f"see its output; 'pbonet doctor' measures the latency to {rtpu}",
    )


def _no_access(rtpu: str) -> AccessError:
    return AccessError(
        "the agent is there, but your request was dropped on the way",
        where=rtpu,
        expected="the keys of a master, and a way that passes commands on",
        remedy="name them with --keys; an observer's keys allow only status, display, "
        "profile and events (`pbonet keys show` shows their role). With a master's "
        f"keys, connect to {rtpu} itself, or to an agent with the keys of a gateway: "
        "other agents' links carry no commands",
    )


def _no_sign(rtpu: str) -> NoAnswerError:
    return NoAnswerError(
        "the agent is registered but does not respond",
        where=rtpu,
        expected=f"an answer within {ASK_TIME + PROOF_TIME:g} s",
        remedy="if its machine is busy, wait and try again; else see its output; if it "
        "hangs, end it with 'kill -9' and start it again: its tasks continue "
        "meanwhile, for its grace",
    )


def no_session(error: zenoh.ZError) -> UnreachableError:
    """Return the error for a session that is closed."""
    return UnreachableError(
        "the connection to the agents is closed", got=str(error), remedy="open it again"
    )


def _refusal(rtpu: str, answer: Answer) -> PbonetError:
    """Return the error of an answer."""
    return placed(rtpu, PbonetError.from_wire(answer.error or {}))


def placed(rtpu: str, error: PbonetError) -> PbonetError:
    """Return an RTPU's error with the RTPU added to its place.

    For example ``arm0/pid`` for a task, ``arm0:/lib/pid.py`` for a file of its machine.
    """
    if not error.where:
        error.where = rtpu
    elif error.where.startswith("/"):
        error.where = f"{rtpu}:{error.where}"
    elif error.where != rtpu and not error.where.startswith((f"{rtpu}/", f"{rtpu}:")):
        error.where = f"{rtpu}/{error.where}"
    return error
