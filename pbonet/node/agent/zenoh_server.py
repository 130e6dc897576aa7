"""An agent's network interface: receives requests, sends answers, publishes events.

A request is passed on at once and its query is kept; the answer is sent when it is
ready, so a slow `init` blocks no other request. A message that cannot be decoded is
answered with an error. Requests that only read have a key of their own, so that access
control can distinguish readers from clients that may command (see
`pbonet.xm.net.roles`).
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

import zenoh

from pbonet.errors import NodeError, PbonetError, ProtocolError
from pbonet.xm.net import (
    XmRequest,
    codec,
    direct,
    key_expressions,
    messages as m,
    roles,
    session,
)

from .idempotency import RecordedRequests, RepeatedRequests
from .shared_memory_status import HANDLED

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.xm.net import AgentInfo, AnyMessage, LinkReport

    from .shared_memory_status import Handled, SharedMemoryStatus

log = logging.getLogger("pbonet.node")

AT_ONCE = re.compile(rb"hello|status|display|write")
SHORT = 1024
"""Maximum bytes of a request that is answered at once."""
PENDING = 2000
"""Maximum number of requests that wait for their answers; more are refused."""
LOOKS = 4
"""Threads for requests that read much, or wait for the RTPU process."""

CHANGES = (
    m.Claim,
    m.CloseTable,
    m.Release,
    m.Spawn,
    m.Control,
    m.Reconfig,
    m.Flag,
    m.Stop,
    m.Replaced,
)
"""Requests that may change a table: answered when the subsystem's other machines have
the change, so that the next request may go to any of them."""


class Node(Protocol):
    """The node that carries out requests."""

    def forward(
        self, n: int, data: bytes, masters: list[tuple[str, str]] | None
    ) -> None:
        """Pass a request on; its answer comes through `Server.answer`."""

    def spread(
        self,
        subsystem: str,
        done: Callable[[], None],
        *,
        take: bool = False,
        value: str = "",
    ) -> None:
        """Call `done` when the other machines have the subsystem's table.

        With `take`, this machine has also processed their states; with `value`, only
        that variable was set.
        """

    def stop_ordered(self, request: m.Stop | m.Replaced) -> None:
        """Repeat a stop to RTPUs that are out of reach, when they are seen again."""

    def done(self, request: m.AnyRequest, data: bytes) -> None:
        """Take in a command that was carried out, with its packed answer."""

    def warned(self, data: bytes) -> bytes:
        """Return the packed answer to a stop with a warning if that is not kept."""
        ...

    def info(self) -> AgentInfo:
        """Return this agent's identity."""
        ...

    def ways(self, *, measure: bool = True) -> LinkReport:
        """Return the paths to the other agents, measured now."""
        ...


_Work: TypeAlias = "Callable[[], None]"
"""A job for the server's thread."""


class _Waiting(NamedTuple):
    """A request that was passed on."""

    reply: Callable[[bytes], None]
    request: m.AnyRequest
    begun_ns: int


class ResourceRequests(Protocol):
    """Handler of requests about semaphores and queues."""

    def take(self, request: XmRequest, reply: Callable[[bytes], None]) -> None:
        """Start a request, which is answered when it is done; returns at once."""


class CommandRecorder(Protocol):
    """Recorder of commands."""

    def commanded(
        self, request: m.AnyRequest, answer: bytes, begun_ns: int, ended_ns: int
    ) -> None:
        """Record a command with its packed answer and its times (ns)."""

    def noted(
        self, request: m.AnyRequest, answer: bytes, begun_ns: int, ended_ns: int
    ) -> bool:
        """Keep a short command that is not recorded; return whether it was kept."""
        ...


class Server:
    """Answers the requests for one RTPU.

    Args:
        session: The agent's session.
        domain: The agent's domain.
        name: The RTPU's name.
        node: Carries out requests.
        mail: Carries out requests about semaphores and queues.
        overview: Carries out requests that need no RTPU process.
        book: Records requests that change something.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: str,
        name: str,
        *,
        node: Node,
        mail: ResourceRequests,
        overview: SharedMemoryStatus,
        book: CommandRecorder,
    ) -> None:
        self._session = session
        self._domain = domain
        self._node, self._mail, self._overview = node, mail, overview
        self._book = book
        self._keys = [key_expressions.rtpu(domain, name, leaf) for leaf in roles.LEAVES]
        self._event_key = key_expressions.rtpu(domain, name, "event")
        self._codec = codec.Codec()
        self._repeats, self._noted = RepeatedRequests(), RecordedRequests()
        self._count = itertools.count(1)
        self._pending: dict[int, _Waiting] = {}
        self._guard = threading.Lock()
        self._pool = ThreadPoolExecutor(2, thread_name_prefix="pbonet claims")
        self._ways = ThreadPoolExecutor(1, thread_name_prefix="pbonet report")
        self._measured: list[tuple[zenoh.Query, m.Links]] = []
        """Requests that wait for a measurement of latencies: one serves all."""
        self._looks = ThreadPoolExecutor(LOOKS, thread_name_prefix="pbonet looks")
        self._arrived: queue.SimpleQueue[_Work | None] = queue.SimpleQueue()
        self._behind = 0
        """Number of requests in the queue; a write must not overtake them."""
        self._queryables: list[zenoh.Queryable[None]] = []
        self._publisher: zenoh.Publisher | None = None
        self._thread = threading.Thread(
            target=self._serve, name="pbonet server", daemon=True
        )

    def start(self) -> None:
        """Declare the queryables and the publisher, and start to answer."""
        self._publisher = self._session.declare_publisher(self._event_key)
        self._queryables = [
            self._session.declare_queryable(
                key,
                direct(self._arrive),
                complete=True,
            )
            for key in self._keys
        ]
        self._thread.start()

    def stop(self) -> None:
        """Stop answering; waiting requests get an error."""
        for queryable in self._queryables:
            with contextlib.suppress(zenoh.ZError):
                queryable.undeclare()  # type: ignore[no-untyped-call]
        self._arrived.put(None)
        if self._thread.is_alive():
            self._thread.join()
        self.fail_pending("the agent ends")
        for pool in (self._pool, self._ways):
            pool.shutdown(wait=True, cancel_futures=True)
        self._looks.shutdown(wait=True)

    def answer(self, n: int, data: bytes) -> None:
        """Send the answer to forwarded request `n`."""
        with self._guard:
            one = self._pending.pop(n, None)
        if one is None:
            return
        self._record(one.request, data, one.begun_ns)
        if isinstance(one.request, m.Stop):
            data = self._node.warned(data)
        if isinstance(one.request, m.Claim):
            self._looks.submit(self._claimed, one.reply, one.request, data)
        else:
            self._spread(one.reply, one.request, data)

    def _claimed(
        self, reply: Callable[[bytes], None], request: m.Claim, data: bytes
    ) -> None:
        """Answer a claim with the status, which may take some time."""
        whole = self._overview.with_status(request, data, self._node.info())
        self._spread(reply, request, whole)

    def _spread(
        self, reply: Callable[[bytes], None], request: m.AnyRequest, data: bytes
    ) -> None:
        """Send an answer when other machines have a table that may have changed."""
        self._node.spread(
            request.subsystem if isinstance(request, CHANGES) else "",
            partial(reply, data),
            take=isinstance(request, m.Claim),
        )

    def _record(self, request: m.AnyRequest, answer: bytes, begun_ns: int) -> None:
        """Record a command once, even if it was repeated."""
        if roles.only_looks(request):
            return
        if self._noted.first(request.client, request.id):
            self._node.done(request, answer)
            self._book.commanded(request, answer, begun_ns, time.monotonic_ns())

    def publish(self, data: bytes) -> None:
        """Publish a packed event; it is dropped if zenoh cannot send it now."""
        if self._publisher is not None:
            with contextlib.suppress(zenoh.ZError):
                self._publisher.put(data)  # pyright: ignore[reportUnknownMemberType]

    def fail_pending(self, reason: str) -> None:
        """Answer all waiting requests with an error."""
        with self._guard:
            waiting = list(self._pending.values())
            self._pending.clear()
        for reply, request, begun_ns in waiting:
            error = NodeError(
                f"the request was not completed: {reason}",
                remedy="'status' shows what was done; then repeat it",
            )
            data = self._codec.pack(codec.failure(error, request.id, request.v))
            self._record(request, data, begun_ns)
            reply(data)

    def submit(self, request: m.AnyRequest, reply: Callable[[bytes], None]) -> None:
        """Pass a request on to the RTPU process, and its packed answer to `reply`."""
        self._pass_on(reply, request, self._codec.pack(request))

    def _arrive(self, query: zenoh.Query) -> None:
        """Receive a query in zenoh's own thread, which must not be blocked.

        Only the agent's identity and the state of a few tasks or variables can be
        returned at once, and one variable be set; another thread does the rest.
        """
        data = query.payload.to_bytes() if query.payload is not None else b""
        if len(data) <= SHORT and AT_ONCE.search(data):
            with contextlib.suppress(PbonetError):
                if self._at_once(query, self._codec.request(data)):
                    return
        self._put(partial(self._take, query))

    def _put(self, work: _Work) -> None:
        """Queue the rest of a request after those that came before it."""
        with self._guard:
            self._behind += 1
        self._arrived.put(partial(self._done, work))

    def _done(self, work: _Work) -> None:
        try:
            work()
        finally:
            with self._guard:
                self._behind -= 1

    def _at_once(self, query: zenoh.Query, request: AnyMessage) -> bool:
        """Answer a request, or start it; return False if this is not possible."""
        if isinstance(request, m.Hello):
            self._introduce(query, request)
            return True
        if isinstance(request, m.Write):
            if self._behind:
                return False
            roles.check(request, str(query.key_expr))
            self._once(query, request, short=True)
            return True
        answer = self._overview.at_once(request)
        if answer is None:
            return False
        self._reply(query, answer)
        return True

    def _introduce(self, query: zenoh.Query, request: m.Hello) -> None:
        info = self._node.info()
        answer = m.Answer(v=request.v, id=request.id, ok=True, result=info)
        self._reply(query, self._codec.pack(answer))

    def _serve(self) -> None:
        while (work := self._arrived.get()) is not None:
            try:
                work()
            except Exception:  # the server survives any request
                log.exception("a request could not be processed")

    def _take(self, query: zenoh.Query) -> None:
        try:
            self._carry_out(query)
        except Exception:
            query.drop()  # type: ignore[no-untyped-call]
            raise

    def _carry_out(self, query: zenoh.Query) -> None:
        data = query.payload.to_bytes() if query.payload is not None else b""
        try:
            request = self._codec.request(data)
            roles.check(request, str(query.key_expr))
            if isinstance(request, m.Hello):
                self._introduce(query, request)
                return
            if isinstance(request, m.Links):
                self._report_ways(query, request)
                return
            if isinstance(request, HANDLED):
                self._handle(query, request)
                return
            if isinstance(request, XmRequest):
                self._mail.take(request, partial(self._reply, query))
                return
            if len(self._pending) >= PENDING:
                raise ProtocolError(
                    "too many requests wait for their answers",
                    expected=f"at most {PENDING}",
                    remedy="wait for answers before sending more requests",
                )
        except PbonetError as error:
            failed = codec.refusal(error, data)
            self._reply(query, self._codec.pack(failed))
            return
        if isinstance(request, m.Stop | m.Replaced):
            self._node.stop_ordered(request)
        self._pass_on(partial(self._reply, query), request, data)

    def _pass_on(
        self, reply: Callable[[bytes], None], request: m.AnyRequest, data: bytes
    ) -> None:
        if isinstance(request, m.Claim):
            self._pool.submit(self._claim, reply, request, data)
        else:
            self._forward(reply, request, data, None)

    def _handle(self, query: zenoh.Query, request: Handled) -> None:
        """Carry out a request in this process; only once if it changes something."""
        if isinstance(request, m.Write):
            self._once(query, request, short=False)
        elif isinstance(request, m.TraceCore):
            self._follow(query, request)
        else:
            self._looks.submit(
                lambda: self._reply(query, self._overview.answer(request))
            )

    def _follow(self, query: zenoh.Query, request: m.TraceCore) -> None:
        """Follow a core once; a repetition gets the same answer, when there is one."""
        who = request.client, request.id or os.urandom(8).hex()
        if self._repeats.begin(who, partial(self._reply, query)):
            self._looks.submit(
                lambda: self._repeats.end(who, self._overview.answer(request))
            )

    def _once(self, query: zenoh.Query, request: m.Write, *, short: bool) -> None:
        """Carry out a request unless it is a repetition; a short one at once."""
        do = self._overview.write_at_once if short else self._overview.answer
        who = request.client, request.id or os.urandom(8).hex()
        if self._repeats.begin(who, partial(self._reply, query)):
            begun_ns = time.monotonic_ns()
            data = do(request)
            if data is None:
                self._put(partial(self._finish_later, who, request, begun_ns))
            else:
                self._finish(who, request, data, begun_ns, short=short)

    def _finish_later(
        self, who: tuple[str, str], request: m.Write, begun_ns: int
    ) -> None:
        data = self._overview.answer(request)
        self._finish(who, request, data, begun_ns, short=True)

    def _finish(
        self,
        who: tuple[str, str],
        request: m.Write,
        data: bytes,
        begun_ns: int,
        *,
        short: bool,
    ) -> None:
        """Answer a request that was carried out, then record it."""
        end = partial(self._repeats.end, who, data)
        self._node.spread(request.subsystem, end, value=request.name)
        said = request, data, begun_ns, time.monotonic_ns()
        if not (short and self._book.noted(*said)):
            # zenoh's thread has no time for this
            self._arrived.put(partial(self._book.commanded, *said))

    def _report_ways(self, query: zenoh.Query, request: m.Links) -> None:
        """Have the paths to the other agents reported by another thread."""
        if not request.measure:
            self._looks.submit(self._report_known_ways, query, request)
            return
        with self._guard:
            self._measured.append((query, request))
        self._ways.submit(self._measure)

    def _report_known_ways(self, query: zenoh.Query, request: m.Links) -> None:
        """Answer with the paths to the other agents as they were measured last."""
        report = self._node.ways(measure=False)
        answer = m.Answer(v=request.v, id=request.id, ok=True, result=report)
        self._reply(query, self._codec.pack(answer))

    def _measure(self) -> None:
        """Answer with the paths to the other agents, which takes their round trips."""
        with self._guard:
            asked, self._measured = self._measured, []
        if not asked:
            return
        report = self._node.ways()
        for query, request in asked:
            answer = m.Answer(v=request.v, id=request.id, ok=True, result=report)
            self._reply(query, self._codec.pack(answer))

    def _claim(
        self, reply: Callable[[bytes], None], request: m.AnyRequest, data: bytes
    ) -> None:
        """Forward a claim with the list of live masters."""
        masters: list[tuple[str, str]] | None
        try:
            tokens = session.alive(
                self._session, key_expressions.masters(self._domain, "*")
            )
        except zenoh.ZError:
            masters = None
        else:
            masters = [key_expressions.master_of(token) for token in tokens]
        self._forward(reply, request, data, masters)

    def _forward(
        self,
        reply: Callable[[bytes], None],
        request: m.AnyRequest,
        data: bytes,
        masters: list[tuple[str, str]] | None,
    ) -> None:
        n = next(self._count)
        with self._guard:
            self._pending[n] = _Waiting(reply, request, time.monotonic_ns())
        try:
            self._node.forward(n, data, masters)
        except PbonetError as error:
            failed = codec.failure(error, request.id, request.v)
            self.answer(n, self._codec.pack(failed))

    def _reply(self, query: zenoh.Query, data: bytes) -> None:
        """Answer on our own key, and close the query: an open one times out."""
        asked = query.key_expr
        own = str(asked)
        if own not in self._keys:  # it has wildcards
            own = next(filter(asked.includes, self._keys), self._keys[0])
        try:
            with query:
                query.reply(own, data)  # pyright: ignore[reportUnknownMemberType]
        except zenoh.ZError as error:
            log.warning("an answer could not be sent: %s", error)
