"""One node of ROS 2 on a zenoh session: publishers, subscribers, services, tokens."""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
import time
from collections import Counter
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

import zenoh
from zenoh import ext

from pbonet.errors import PbonetError, ProtocolError
from pbonet.svar import now_ns
from pbonet.xm.net import direct

from .wire_format import (
    Attachment,
    End,
    Kind,
    Node,
    Qos,
    must_be_short,
    packed,
    parse_token,
    tokens_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from .message_types import MessageTypes
    from .repeated_warnings import Warnings

_WAITING: Final = 32
"""Requests to services that wait at most; more are refused."""
_LATER: Final = 8
"""Answers of a service that one client may wait for; more are refused."""
_LATER_OF_ALL: Final = 256
"""Answers that all clients may wait for; a client chooses its own identity."""
_SHORT: Final = 4096
"""Bytes of a message that is taken in zenoh's own thread."""
_CDR: Final = "application/cdr"
_SERVICE_QOS: Final = Qos()
_OTHERS: Final = {
    Kind.PUBLISHER: Kind.SUBSCRIBER,
    Kind.SUBSCRIBER: Kind.PUBLISHER,
    Kind.SERVICE: Kind.CLIENT,
    Kind.CLIENT: Kind.SERVICE,
}
_KEPT: Final = 10_000
"""Publishers, subscribers, services and clients of others that are kept at most; those
beyond that are compared with what this node has when they come, and not later."""
_END_TIME: Final = 2.0


class Publisher:
    """Publishes messages of one topic, and never waits for a subscriber.

    Args:
        session: The session.
        end: What it is.
        qos: Its quality of service.
    """

    def __init__(self, session: zenoh.Session, end: End, qos: Qos) -> None:
        self.end = end
        self._numbers = itertools.count(1)  # of /rosout, several threads publish
        self._gid = end.gid
        told: dict[str, Any] = {
            "encoding": _CDR,
            "congestion_control": zenoh.CongestionControl.DROP,
        }
        if qos.transient_local:  # as rmw_zenoh has it
            cache = ext.CacheConfig(qos.depth)
            publisher: Any = ext.declare_advanced_publisher(
                session, end.key, cache=cache, publisher_detection=True, **told
            )
        else:
            publisher = session.declare_publisher(end.key, **told)
        self._publisher = publisher  # undeclared when it is dropped
        self._put = publisher.put

    def put(self, data: bytes, stamp_ns: int) -> None:
        """Publish a message; what a slow subscriber has no room for is dropped.

        Args:
            data: The message in CDR.
            stamp_ns: When its content was made, nanoseconds since 1970.
        """
        self._put(data, attachment=packed(next(self._numbers), stamp_ns, self._gid))


class _Newest:
    """The newest message of a topic, taken at most so often, one at a time.

    A short one is taken at once, in zenoh's own thread, when none waits and none is
    being taken; a change of threads would take longer than the rest. Others wait, each
    in place of the one before it, for a thread of its own (`run`).

    Args:
        take: Called with a message and when it came; it does not raise.
        max_hz: The highest rate, Hz.
    """

    def __init__(
        self, take: Callable[[zenoh.Sample, int], None], max_hz: float
    ) -> None:
        self._take, self._pause_ns = take, round(1e9 / max_hz)
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._got: tuple[zenoh.Sample, int] | None = None
        self._due_ns = 0
        self._taking = self._over = False

    def put(self, sample: zenoh.Sample) -> None:
        """Take a message, or replace the one that waits; zenoh calls it."""
        arrived = now_ns()
        short = len(sample.payload) <= _SHORT
        with self._lock:
            waits = self._got is not None
            if waits or self._taking or not short or arrived < self._due_ns:
                self._got = sample, arrived
                if not waits:
                    self._changed.notify()
                return
            self._taking, self._due_ns = True, arrived + self._pause_ns
        self._take(sample, arrived)
        self._finish()

    def run(self) -> None:
        """Take those that wait, until the end."""
        while (got := self._wait()) is not None:
            self._take(*got)
            self._finish()

    def end(self) -> None:
        """Wake the thread for the last time."""
        with self._changed:
            self._over = True
            self._changed.notify()

    def _finish(self) -> None:
        with self._lock:
            self._taking = False
            if self._got is not None:
                self._changed.notify()

    def _wait(self) -> tuple[zenoh.Sample, int] | None:
        """Wait for a message that may be taken; None at the end."""
        with self._changed:
            while not self._over:
                left_ns = self._due_ns - now_ns()
                if self._got is None or self._taking:
                    self._changed.wait()
                elif left_ns > 0:
                    self._changed.wait(left_ns * 1e-9)
                else:
                    got, self._got = self._got, None
                    self._taking, self._due_ns = True, now_ns() + self._pause_ns
                    return got
        return None


class Requests(queue.Queue["tuple[Callable[[Any], Any], End, Any] | None"]):
    """Requests that wait for one thread."""

    def __init__(self) -> None:
        super().__init__(_WAITING)

    def end(self) -> None:
        """Let the thread end; if all places are taken, the first request is dropped."""
        while True:
            with contextlib.suppress(queue.Full):
                self.put_nowait(None)
                return
            with contextlib.suppress(queue.Empty):
                self.get_nowait()


class _Later:
    """How many answers of each service each client waits for, which come later."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waits: dict[str, Counter[bytes]] = {}

    def refusal(self, service: str, client: bytes) -> str:
        """Return why a client may not ask now; empty: it may."""
        with self._lock:
            waits = self._waits.get(service)
            if waits is None:
                return ""
            if waits[client] >= _LATER:
                return f"{_LATER} requests of this client wait already"
            full = waits.total() >= _LATER_OF_ALL
            return f"{_LATER_OF_ALL} requests wait already; ask later" if full else ""

    def add(self, service: str, client: bytes, answer: Future[Any]) -> None:
        """Count an answer until it is there."""
        with self._lock:
            self._waits.setdefault(service, Counter())[client] += 1
        answer.add_done_callback(lambda _: self._done(service, client))

    def _done(self, service: str, client: bytes) -> None:
        with self._lock:
            waits = self._waits[service]
            waits[client] -= 1
            if not waits[client]:
                del waits[client]


class RosNode:
    """A node with all that it has.

    Args:
        session: A session that no other node uses.
        node: Domain, name and namespace.
        types: The types of messages.
        warnings: What a user should know.
    """

    def __init__(
        self,
        session: zenoh.Session,
        node: Node,
        types: MessageTypes,
        warnings: Warnings,
    ) -> None:
        self.session, self.types, self.warnings = session, types, warnings
        self.node = node._replace(session=str(session.info.zid()))
        self.ends: list[End] = []
        self._others: dict[str, End] = {}
        """By token; some were there before what this node has."""
        self._declared: list[Any] = []
        self._threads: list[threading.Thread] = []
        self._ends: list[Callable[[], None]] = []
        """Functions that let the threads end, one each."""
        self._requests = Requests()
        self._later = _Later()

    def open(self) -> None:
        """Show the node, and begin to answer and to look for others."""
        live = self.session.liveliness()
        self._declared += [
            live.declare_token(self.node.token),
            live.declare_subscriber(
                tokens_of(self.node.domain), direct(self._on_token), history=True
            ),
        ]
        self._work(self._requests, "ros services")

    def queue(self, name: str) -> Requests:
        """Return a queue for services that wait for no others; a thread answers it."""
        requests = Requests()
        self._work(requests, name)
        return requests

    def close(self) -> None:
        """Undeclare everything, and close the session."""
        for one in reversed(self._declared):
            with contextlib.suppress(zenoh.ZError):
                one.undeclare()
        for end in self._ends:
            end()
        with contextlib.suppress(zenoh.ZError):
            self.session.close()  # type: ignore[no-untyped-call]
        for thread in self._threads:
            thread.join(_END_TIME)

    def name_of(self, topic: str) -> str:
        """Return the full name of a topic or service."""
        topic = topic.removeprefix("~/")
        return topic if topic.startswith("/") else f"{self.node.full_name}/{topic}"

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        """Declare a publisher."""
        end = self._end(Kind.PUBLISHER, topic, kind, qos)
        made = Publisher(self.session, end, qos)
        self._declare(end)
        return made

    def subscribe(
        self,
        topic: str,
        kind: str,
        qos: Qos,
        take: Callable[[zenoh.Sample, int], None],
        max_hz: float,
    ) -> End:
        """Declare a subscriber; only the newest message waits, all others are dropped.

        Args:
            topic: The topic.
            kind: Its type.
            qos: Its quality of service.
            take: Called with messages and when each arrived (`now_ns`), one at a time,
                in zenoh's thread or in one of its own.
            max_hz: The highest rate, Hz.
        """
        end = self._end(Kind.SUBSCRIBER, topic, kind, qos)
        newest = _Newest(partial(self._safely, end.name, take), max_hz)
        self._ends.append(newest.end)
        self._start(newest.run, f"ros {topic}")
        handler = direct(newest.put)
        if qos.transient_local:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            self._declared.append(
                ext.declare_advanced_subscriber(
                    self.session, end.key, handler, history=history
                )
            )
        else:
            self._declared.append(self.session.declare_subscriber(end.key, handler))
        self._declare(end)
        return end

    def serve(
        self,
        name: str,
        kind: str,
        answer: Callable[[Any], Any],
        requests: Requests | None = None,
    ) -> None:
        """Declare a service.

        Args:
            name: Its name.
            kind: Its type, such as ``rcl_interfaces/srv/GetParameters``.
            answer: Returns the response to a request, or a `Future` for it; one at a
                time is called.
            requests: Where its requests wait (`queue`); None: with all others.
        """
        end = self._end(Kind.SERVICE, name, kind, _SERVICE_QOS)
        requests = requests or self._requests

        def take(query: zenoh.Query) -> None:
            try:
                must_be_short(_size_of(query))
                requests.put_nowait((answer, end, query))
            except ProtocolError as error:
                _refuse(query, str(error))
            except queue.Full:
                _refuse(query, f"{end.name}: too many requests wait; ask again")

        self._declared.append(
            self.session.declare_queryable(end.key, direct(take), complete=True)
        )
        self._declare(end)

    def _end(self, kind: Kind, name: str, type_name: str, qos: Qos) -> End:
        made = End(
            self.node,
            len(self.ends) + 1,
            kind,
            self.name_of(name),
            type_name,
            self.types.hash(type_name),
            qos.text,
        )
        self.ends.append(made)
        for other in list(self._others.values()):
            self._compare(made, other)
        return made

    def _declare(self, end: End) -> None:
        self._declared.append(self.session.liveliness().declare_token(end.token))

    def _start(self, what: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=what, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    # -- other nodes ------------------------------------------------------------------

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Compare an end of another node that has come with those of this one."""
        token = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT:
            self._others.pop(token, None)
            return
        other = parse_token(token)
        if not isinstance(other, End):
            return
        if len(self._others) < _KEPT:
            self._others[token] = other
        for own in list(self.ends):
            self._compare(own, other)

    def _compare(self, own: End, other: End) -> None:
        """Tell of an end that means another type; its messages never come here."""
        if other.name != own.name or other.kind != _OTHERS[own.kind]:
            return
        if (other.type, other.hash) != (own.type, own.hash):
            what = "another definition" if other.type == own.type else other.type
            self.warnings.warn(
                own.name,
                f"node {other.node.full_name} means {what}",
                f" (expected {own.type} {own.hash}, got {other.type} {other.hash})"
                "; no message passes",
            )

    # -- services ---------------------------------------------------------------------

    def _work(self, requests: Requests, name: str) -> None:
        """Start a thread that answers requests."""

        def run() -> None:
            while (item := requests.get()) is not None:
                answer, end, query = item
                self._safely(end.name, self._reply, answer, end, query)

        self._ends.append(requests.end)
        self._start(run, name)

    def _reply(
        self,
        answer: Callable[[Any], Any],
        end: End,
        query: Any,  # noqa: ANN401 - zenoh's, whose types are partly unknown
    ) -> None:
        """Answer a request, now or when its future has a result."""
        try:
            asked = Attachment.unpack(
                query.attachment.to_bytes() if query.attachment else b""
            )
            data = query.payload.to_bytes() if query.payload else b""
            request = self.types.decode(f"{end.type}_Request", data)
        except ProtocolError as error:
            _refuse(query, str(error))
            return
        if why := self._later.refusal(end.name, asked.gid):
            _refuse(query, f"{end.name}: {why}")
            return
        try:
            response = answer(request)
        except Exception as error:
            _refuse(query, f"{end.name} failed: {error}")
            raise
        comes_later = isinstance(response, Future)
        if comes_later:
            later = cast("Future[Any]", response)
            self._later.add(end.name, asked.gid, later)
            later.add_done_callback(
                lambda done: self._safely(
                    end.name, self._respond, end, query, asked, done.result()
                )
            )
        else:
            self._respond(end, query, asked, response)

    def _respond(
        self,
        end: End,
        query: Any,  # noqa: ANN401 - as above
        asked: Attachment,
        response: Any,  # noqa: ANN401 - by its type
    ) -> None:
        """Send the response to a request."""
        with query:
            try:
                data = self.types.encode(f"{end.type}_Response", response)
            except Exception as error:
                query.reply_err(f"{end.name} failed: {error}")
                raise
            back = asked._replace(stamp_ns=time.time_ns())
            query.reply(end.key, data, encoding=_CDR, attachment=back.pack())

    def _safely(self, name: str, what: Callable[..., object], *given: object) -> None:
        """Call a function; the node outlives whatever a message does."""
        try:
            what(*given)
        except PbonetError as error:
            self.warnings.warn_of(name, error)
        except zenoh.ZError as error:
            self.warnings.warn(name, "it could not be sent", f": {error}")
        except Exception as error:  # noqa: BLE001 - no message ends the node
            self.warnings.failed(name, error)


def _size_of(query: Any) -> int:  # noqa: ANN401 - as above
    """Return how many bytes of a sender's choice a request has."""
    parts = query.payload, query.attachment, str(query.parameters)
    return sum(len(one) for one in parts if one is not None)


def _refuse(query: Any, text: str) -> None:  # noqa: ANN401 - as above
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(text)
