"""The express mail server of an RTPU (Stewart 1994, sections 5.3 and 5.4).

It acts for clients on other machines: it attaches to semaphores and queues of this
machine on their behalf, and waits in the same lines as local tasks, with the client's
priority. A client's liveliness token is its lease. When the token disappears, the
client's waits end, unacknowledged messages and units are returned, and a critical
section that it held counts as held by a process that died.

Waits run in threads of their own, at most `WAITS`; nothing here is real-time.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import zenoh

from pbonet import xm
from pbonet.errors import (
    NodeError,
    PbonetError,
    XmDestroyedError,
    XmError,
    XmFullError,
    XmLapsedError,
)
from pbonet.xm.ipc import mailboxes, names, overview
from pbonet.xm.net import (
    FileWrite,
    codec,
    direct,
    key_expressions,
    messages as m,
    resource_messages as r,
    roles,
)

from .idempotency import RepeatedRequests
from .stop_orders import parted

if TYPE_CHECKING:
    from collections.abc import Callable

    from .file_server import FileServer

log = logging.getLogger("pbonet.node")

WAITS = 64
"""Maximum number of clients that wait at a time."""
OTHERS = 8
"""Maximum number of requests at a time that do not wait."""
WAITING = 1000
"""Maximum number of requests that wait for a thread."""
HANDLES = 512
"""Maximum number of resources attached for clients at a time."""
BROKEN_OFF = 256
"""Maximum number of remembered waits that were cancelled before they arrived."""
TOKEN_TIME = 1.0
"""Seconds to wait for the token of a client that attaches."""


class Held:
    """A resource to which the agent is attached for a client."""

    def __init__(self, client: str, thing: xm.Semaphore | xm.Queue) -> None:
        self.client, self.thing = client, thing
        self.busy = 0
        """Requests under way."""
        self.gone = False
        self.loose: dict[str, r.Took] = {}
        """Items taken and not yet acknowledged, by the client's name for them."""

    def give_back(self, took: r.Took) -> None:
        """Return what a client did not receive."""
        if isinstance(self.thing, xm.Queue):
            self.thing.send(took.data, took.priority, full=xm.Full.DROP)
        else:
            self.thing.v()


class ResourceServer:
    """Carries out clients' requests about an RTPU's semaphores and queues.

    Args:
        session: The agent's session.
        domain: Its domain.
        rtpu: Its name.
        fileserver: Reads and writes files.
        parts: See `Mail`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: str,
        rtpu: str,
        fileserver: FileServer,
        parts: Callable[[str, str], bool] = lambda _, __: False,
    ) -> None:
        self._domain, self._rtpu, self._fileserver = domain, rtpu, fileserver
        self._parts = parts
        self._codec = codec.Codec()
        self._repeats = RepeatedRequests()
        self._change = threading.Condition()
        self._clients: set[str] = set()
        self._held: dict[int, Held] = {}
        self._takes: dict[str, Held] = {}
        """Waits under way, by the client's name for them."""
        self._broken_off: dict[str, None] = {}
        self._count = 0
        self._queued = self._waits = 0
        self._over = False
        self._do: dict[type, Callable[[Any], Any]] = {
            r.Attach: self._attach,
            r.Detach: self._detach,
            r.Take: self._take,
            r.Await: self._await,
            r.Put: self._put,
            r.Give: self._give,
            r.Look: self._state_of,
            r.Settle: self._settle,
            r.Overview: self._list,
            r.Interrupt: self._interrupt,
            **fileserver.operations,
        }
        self._pool = ThreadPoolExecutor(WAITS + OTHERS, "pbonet office")
        self._subscriber = session.liveliness().declare_subscriber(
            key_expressions.customer(domain, "*"),
            direct(self._on_token),
            history=True,
        )

    def stop(self) -> None:
        """End all waits and release all resources."""
        with self._change:
            if self._over:
                return
            self._over = True
            clients = {held.client for held in self._held.values()} | self._clients
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        for client in clients:
            self._lost(client)
        self._pool.shutdown(wait=True)
        mailboxes.forget()

    def is_used(self) -> bool:
        """Return whether clients have resources, unfinished files or requests here."""
        with self._change:
            found = bool(self._held) or self._queued > 0
        return found or self._fileserver.is_used()

    # -- clients -----------------------------------------------------------------------

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Record a token; runs in zenoh's thread, which must not be blocked."""
        client = key_expressions.last(str(sample.key_expr))
        with self._change:
            if sample.kind == zenoh.SampleKind.PUT:
                self._clients.add(client)
            else:
                self._clients.discard(client)
                if not self._over:
                    self._pool.submit(self._lost, client)
            self._change.notify_all()

    def _lost(self, client: str) -> None:
        """Clean up after a client that is gone."""
        with self._change:
            theirs = [
                (n, held) for n, held in self._held.items() if held.client == client
            ]
            for n, held in theirs:
                del self._held[n]
                held.gone = True
        for _, held in theirs:
            self._clean(held)
        self._fileserver.lost(client)

    def _clean(self, held: Held) -> None:
        """Release a lost client's resource when no request uses it any longer."""
        with self._change:
            if held.busy or not held.gone:
                return
            loose, held.loose = held.loose, {}
        try:
            binary = isinstance(held.thing, xm.Semaphore) and held.thing.binary
            for took in () if binary else loose.values():
                held.give_back(took)
        except XmDestroyedError:
            pass
        except XmError as error:
            log.warning("%s: what a lost client took is lost: %s", self._rtpu, error)
        finally:
            held.thing.close()

    # -- requests ----------------------------------------------------------------------

    def take(self, request: r.XmRequest, reply: Callable[[bytes], None]) -> None:
        """Start a request, which is answered when it is done; returns at once."""
        who = request.client, request.id
        once = not roles.only_looks(request)
        if once and not self._repeats.begin(who, reply):
            return
        answer = partial(self._repeats.end, who) if once else reply
        wait = getattr(request, "wait", 0.0) > 0.0
        try:
            if self._is_apart(request):
                raise parted(_rtpu_of(request.client))
            self._admit(wait=wait)
        except PbonetError as error:
            answer(self._codec.pack(codec.failure(error, request.id, request.v)))
            return
        self._pool.submit(self._serve, request, answer, wait=wait)

    def _admit(self, *, wait: bool) -> None:
        with self._change:
            if self._over:
                raise NodeError("the agent ends", where=self._rtpu, remedy="ask again")
            if self._queued >= WAITING or (wait and self._waits >= WAITS):
                raise XmFullError(
                    "too many clients on other machines wait",
                    where=self._rtpu,
                    expected=f"at most {WAITS} that wait for something",
                    remedy="wait with a time limit, or receive more often",
                )
            self._queued += 1
            self._waits += wait

    def _is_apart(self, request: r.XmRequest) -> bool:
        """Return whether a stop that was missed keeps its sender apart from here."""
        whose = request.subsystem  # empty: a program, which no stop ends
        return bool(whose) and self._parts(whose, _rtpu_of(request.client))

    def _serve(
        self, request: r.XmRequest, reply: Callable[[bytes], None], *, wait: bool
    ) -> None:
        asked = request.id, request.v
        try:
            if isinstance(request, FileWrite) and request.offset == 0:
                self._must_live(request.client)
            result = self._do[type(request)](request)
            answer = m.Answer(v=request.v, id=request.id, ok=True, result=result)
        except PbonetError as error:
            answer = codec.failure(error, request.id, request.v)
        except (ValueError, TypeError, OverflowError) as error:
            answer = codec.failure(_unfit(self._rtpu, error), *asked)
        except Exception as error:  # the server survives any request
            log.exception("%s: a request could not be carried out", self._rtpu)
            answer = codec.failure(_unfit(self._rtpu, error), *asked)
        with self._change:
            self._queued -= 1
            self._waits -= wait
        reply(self._codec.pack(answer))

    # -- operations --------------------------------------------------------------------

    def _name(self, resource: str) -> names.Name:
        found = names.parse_at(f"{self._rtpu}:{resource}", self._rtpu)
        return found._replace(domain=self._domain)

    def _attach(self, request: r.Attach) -> r.Attached:
        client, name = request.client, self._name(request.name)
        kind: Any = {"sem": xm.Semaphore, "queue": xm.Queue}.get(request.kind)
        if kind is None:
            raise XmError(
                "resources of this kind cannot be used from another machine",
                where=str(name),
                expected="sem or queue",
                got=request.kind[:20],
                remedy="run the same pbonet version on every machine",
            )
        self._must_live(client)
        with self._change:
            if len(self._held) >= HANDLES:
                raise XmFullError(
                    "too many resources are used from other machines",
                    where=self._rtpu,
                    expected=f"at most {HANDLES} attached",
                    remedy="close those that are no longer needed",
                )
        thing = _open(kind, name, request.create)
        settings = overview.settings_of(thing)
        with self._change:
            there = client in self._clients and not self._over
            if there:
                self._count += 1
                self._held[self._count] = Held(client, thing)
                return r.Attached(handle=self._count, settings=settings)
        thing.close()
        raise _lapsed(str(name))

    def _must_live(self, client: str) -> None:
        """Wait briefly for a client's token, which may be slower than its request."""
        end = time.monotonic() + TOKEN_TIME
        with self._change:
            while client not in self._clients:
                left = end - time.monotonic()
                if left <= 0 or not self._change.wait(left):
                    raise _lapsed(self._rtpu)

    def _begin(self, request: Any) -> Held:  # noqa: ANN401 - any with a handle
        with self._change:
            held = self._held.get(request.handle)
            if held is None or held.client != request.client:
                raise _lapsed(self._rtpu)
            take = getattr(request, "take", None)
            if take is not None:
                if take in self._broken_off:
                    raise _given_up(self._rtpu)
                self._takes[take] = held
            held.busy += 1
            return held

    def _end(self, request: Any, held: Held) -> None:  # noqa: ANN401
        with self._change:
            held.busy -= 1
            self._takes.pop(getattr(request, "take", ""), None)
        self._clean(held)

    def _still(self, request: Any, held: Held) -> bool:  # noqa: ANN401
        """Return whether a wait under way is still wanted."""
        ended = self._over or held.gone or request.take in self._broken_off
        return not (ended or self._is_apart(request))

    def _take(self, request: r.Take) -> r.Took:
        held = self._begin(request)
        try:
            took = self._wait_for(request, held)
            with self._change:
                wanted = self._still(request, held)
                if wanted and took.code:
                    held.loose[request.take] = took
            if wanted or not took.code:
                return took
            held.give_back(took)
            raise _given_up(self._rtpu)
        finally:
            self._end(request, held)

    def _wait_for(self, request: r.Take, held: Held) -> r.Took:
        thing, until = held.thing, _until(request.wait)
        still = partial(self._still, request, held)
        if isinstance(thing, xm.Semaphore):
            code = thing.p(until, priority=request.priority, still=still)
            return r.Took(code=int(code))
        most = max(0, min(request.most, r.LONGEST))
        found = thing.letter(until, priority=request.priority, most=most, still=still)
        if found is None:
            return r.Took(code=0)
        return r.Took(code=1, data=found[0], priority=found[1])

    def _settle(self, request: r.Settle) -> None:
        with self._change:
            held = next(
                (h for h in self._held.values() if request.take in h.loose), None
            )
            took = held.loose.pop(request.take) if held is not None else None
            if took is None and not request.keep:
                self._broken_off[request.take] = None
                while len(self._broken_off) > BROKEN_OFF:
                    del self._broken_off[next(iter(self._broken_off))]
        if held is not None and took is not None and not request.keep:
            held.give_back(took)

    def _await(self, request: r.Await) -> bool:
        held = self._begin(request)
        try:
            return _queue(held).wait(
                _until(request.wait),
                priority=request.priority,
                still=partial(self._still, request, held),
            )
        finally:
            self._end(request, held)

    def _put(self, request: r.Put) -> bool:
        if request.name:
            queue = xm.Queue.attach(self._name(request.name))
            with contextlib.closing(queue):
                full = xm.Full(request.full)
                return queue.send(request.data, request.priority, full=full)
        held = self._begin(request)
        try:
            return _queue(held).send(
                request.data,
                request.priority,
                full=xm.Full(request.full),
                until_ns=_until(request.wait),
                wait_priority=request.wait_priority,
                still=partial(self._still, request, held),
            )
        finally:
            self._end(request, held)

    def _give(self, request: r.Give) -> bool:
        if request.name:
            semaphore = xm.Semaphore.attach(self._name(request.name))
            with contextlib.closing(semaphore):
                return semaphore.v()
        held = self._begin(request)
        try:
            return _semaphore(held).v()
        finally:
            self._end(request, held)

    def _state_of(self, request: r.Look) -> r.Seen:
        held = self._begin(request)
        try:
            return overview.state_of(held.thing)
        finally:
            self._end(request, held)

    def _list(self, request: r.Overview) -> list[r.Resource]:
        return overview.resources(self._domain, self._rtpu, request.kind)

    def _interrupt(self, request: r.Interrupt) -> None:
        box = self._name(mailboxes.PREFIX + request.name)
        mailboxes.interrupt_here(box, request.value)

    def _detach(self, request: r.Detach) -> None:
        held = self._begin(request)
        try:
            if request.destroy:
                held.thing.destroy()
            with self._change:
                self._held.pop(request.handle, None)
                held.gone = True
        finally:
            self._end(request, held)


def _open(kind: Any, name: names.Name, create: dict[str, Any] | None) -> Any:  # noqa: ANN401
    """Attach to a resource, or make it."""
    return kind.attach(name) if create is None else kind.create(name, **create)


def _queue(held: Held) -> xm.Queue:
    if not isinstance(held.thing, xm.Queue):
        raise _other(held)
    return held.thing


def _semaphore(held: Held) -> xm.Semaphore:
    if not isinstance(held.thing, xm.Semaphore):
        raise _other(held)
    return held.thing


def _other(held: Held) -> XmError:
    return XmError(
        "it is of another kind",
        where=held.thing.name,
        remedy="run the same pbonet version on every machine",
    )


def _rtpu_of(client: str) -> str:
    """Return the RTPU of a task's process, by the name of its channel."""
    return client.rsplit("-", 2)[0]


def _until(wait: float) -> int:
    """Return the end of a wait in CLOCK_MONOTONIC nanoseconds."""
    return time.monotonic_ns() + round(min(wait, 1e9) * 1e9) if wait > 0 else 0


def _lapsed(where: str) -> XmLapsedError:
    return XmLapsedError(
        "the agent no longer knows this client",
        where=where,
        got="a link that was lost meanwhile, or an agent that was restarted",
        remedy="attach again; semaphores that it held are released",
    )


def _unfit(where: str, error: Exception) -> XmError:
    return XmError(
        "this cannot be carried out",
        where=where,
        got=f"{type(error).__name__}: {error}",
        remedy="see docs/xm.md for valid requests",
    )


def _given_up(where: str) -> XmError:
    return XmError("the wait was cancelled", where=where, remedy="wait again")
