"""The network interface: control by other programs (Stewart 1994, 4.4.2).

A master that serves a port answers msgpack maps on ``pbonet/DOMAIN/net/PORT``. Any
zenoh client can send them; `docs/commands.md` describes how; they need nothing of
pbonet. A request is ``{"v": 1, "id", "client", "command", "args": {...}}`` or has
``"line"``, a command line as at the prompt, in place of command and arguments; the
answer is that of an agent (`pbonet.xm.net.messages.Answer`).

Control is handed to one client at a time: the first that commands. It must hold a
liveliness token under the port, so that its loss is noticed; with its ``quit`` or its
loss control goes back. Watching and ``stop`` are open to everybody.
"""

from __future__ import annotations

import contextlib
import queue
import re
import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec
import zenoh
from msgspec import Struct

from pbonet.errors import (
    ClaimError,
    DuplicateNameError,
    NodeError,
    PbonetError,
    ProtocolError,
    StateError,
)
from pbonet.lazy import logger
from pbonet.xm.net import check_name, codec, direct, key_expressions, messages as m, rpc

from . import render
from .command_session import Call, CommandSession, Reply, convert
from .commands import find

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.master.subsystem import Subsystem

_KEPT: Final = 1000
_SESSIONS: Final = 100
"""Clients whose columns, baselines and default tasks are remembered."""
_CLIENT: Final = re.compile(r"[A-Za-z0-9_.\-]{1,64}")
_TOKEN_TIME: Final = 1.0
_LOOK: Final = 0.2
"""Seconds between checks whether serving is to end."""


def _note(text: str) -> None:
    logger("pbonet.master").info("%s", text)


class Order(Struct, kw_only=True):
    """A request to a master's port."""

    v: int = m.VERSION
    id: str = ""
    client: str = ""
    command: str = ""
    args: dict[str, Any] = {}
    line: str = ""


_ORDER: Final = msgspec.msgpack.Decoder(Order)


class Port:
    """A port at which programs on the network control a subsystem.

    Args:
        subsystem: The subsystem, which is open.
        name: The port's name.
        handover: Whether one client takes control and holds it until it ends. Without,
            every client may command, one after the other.
        told: Called with a sentence when control changes hands.

    Raises:
        NodeError: The name cannot be one.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        name: str,
        *,
        handover: bool = True,
        told: Callable[[str], None] = _note,
    ) -> None:
        self.name = check_name("a port", name)
        self.ended = threading.Event()
        """Set when the client that had control has ended or is lost."""
        self._subsystem = subsystem
        self._domain = subsystem.domain
        self._handover = handover
        self._told = told
        self._key = key_expressions.network(subsystem.domain, name)
        self._lock = threading.Condition()
        self._holder = ""
        self._living: set[str] = set()
        """Clients with a token. Asking for the tokens from a session that also
        subscribes to them misses some now and then."""
        self._sessions: OrderedDict[str, CommandSession] = OrderedDict()
        """By client, the one that asked last at the end."""
        self._answers: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._orders: queue.SimpleQueue[tuple[zenoh.Query, Order] | None] = (
            queue.SimpleQueue()
        )
        self._arrived: queue.SimpleQueue[zenoh.Query | None] = queue.SimpleQueue()
        self._declared: list[Any] = []
        self._threads = [
            threading.Thread(target=self._sort, name="port", daemon=True),
            threading.Thread(target=self._work, name="port work", daemon=True),
        ]

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Answer from now on.

        Raises:
            DuplicateNameError: Another master serves a port of this name.
            UnreachableError: The connection to the agents is closed.
        """
        client = self._subsystem.clients.client
        if client.tokens(self._key):
            raise DuplicateNameError(
                f"the port {self.name} is taken",
                where=self._key,
                remedy="choose another name",
            )
        session = client.session
        try:
            self._declared = [
                session.declare_queryable(
                    self._key, zenoh.handlers.Callback(self._arrived.put)
                ),
                session.liveliness().declare_subscriber(
                    key_expressions.network_client(self._domain, self.name, "*"),
                    direct(self._on_token),
                    history=True,
                ),
                session.liveliness().declare_token(self._key),
            ]
        except zenoh.ZError as error:
            raise rpc.no_session(error) from None
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Answer no more."""
        for declared in reversed(self._declared):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
        self._arrived.put(None)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(1.0)  # a command that hangs is abandoned
        self._declared = []

    def serve(self, stopped: threading.Event) -> None:
        """Wait until the client that took control has ended, or `stopped` is set."""
        while not self.ended.wait(_LOOK):
            if stopped.is_set():
                return

    # -- in zenoh's threads -----------------------------------------------------------

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Notice which clients live, and the loss of the one that has control."""
        client = key_expressions.last(str(sample.key_expr))
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._living.add(client)
                self._lock.notify_all()
                return
            self._living.discard(client)
        self._give_back(client, "is gone")

    # -- in our own -------------------------------------------------------------------

    def _sort(self) -> None:
        """Answer requests that need no waiting; queue the rest after other commands."""
        while (query := self._arrived.get()) is not None:
            data = query.payload.to_bytes() if query.payload is not None else b""
            try:
                order = _decode(data)
            except PbonetError as error:
                failed = codec.refusal(error, data)
                self._reply(query, msgspec.msgpack.encode(failed))
                continue
            if order.command == "stop" or order.line.strip() == "stop":
                threading.Thread(
                    target=self._carry_out, args=(query, order), daemon=True
                ).start()
            else:
                self._orders.put((query, order))
        self._orders.put(None)

    def _work(self) -> None:
        while (item := self._orders.get()) is not None:
            self._carry_out(*item)

    def _carry_out(self, query: zenoh.Query, order: Order) -> None:
        key = (order.client, order.id)
        data = self._answers.get(key) if order.id else None
        if data is None:
            data = msgspec.msgpack.encode(self._answer(order))
            if order.id:
                self._answers[key] = data
                while len(self._answers) > _KEPT:
                    self._answers.popitem(last=False)
        self._reply(query, data)

    def _answer(self, order: Order) -> m.Answer:
        try:
            reply = self._do(order)
        except PbonetError as error:
            return codec.failure(error, order.id)
        except Exception as error:  # the port outlives any command
            log = logger("pbonet.master")
            log.exception("the command %s failed inside pbonet", order.command)
            return codec.failure(
                NodeError(
                    f"it failed inside pbonet: {type(error).__name__}: {error}",
                    remedy="see the output of the master's program, and report it",
                ),
                order.id,
            )
        if reply is None:
            return m.Answer(id=order.id, ok=True)
        text = render.text(reply.command, reply.data)
        return m.Answer(
            id=order.id,
            ok=True,
            result={"command": reply.command, "data": reply.data, "text": text},
            warnings=reply.warnings,
        )

    def _do(self, order: Order) -> Reply | None:
        session = self._session_of(order.client)
        if order.line:
            call = session.read(order.line)
        else:
            command = find(order.command)
            call = Call(command, convert(command, order.args))
        if call is None:
            return None
        if self._handover and call.command.name == "quit":
            self._must_hold(order.client)
        elif self._handover and call.changes:
            self._take(order.client)
        reply = session.perform(call)
        if session.ended:
            self._sessions.pop(order.client, None)
            if order.client:
                self._give_back(order.client, "has ended")
        return reply

    def _session_of(self, client: str) -> CommandSession:
        """Return the session of a client; the oldest ones are forgotten."""
        with self._lock:
            session = self._sessions.setdefault(client, CommandSession(self._subsystem))
            self._sessions.move_to_end(client)
            while len(self._sessions) > _SESSIONS:
                oldest = next(name for name in self._sessions if name != self._holder)
                del self._sessions[oldest]
            return session

    # -- who has control --------------------------------------------------------------

    def _take(self, client: str) -> None:
        """Give control to a client, unless another one has it."""
        if self._holder == client:
            return
        if self._holder:
            raise ClaimError(
                "another client has control",
                where=f"port {self.name}",
                got=self._holder,
                remedy="wait for its end; reading and stop are open to every client",
            )
        with self._lock:  # a new token may still be on its way
            if self._lock.wait_for(lambda: client in self._living, _TOKEN_TIME):
                self._holder = client
        if self._holder != client:
            token = key_expressions.network_client(
                self._domain, self.name, client or "NAME"
            )
            raise ClaimError(
                "a client that takes control needs a liveliness token",
                where=f"port {self.name}",
                expected=f"a liveliness token {token}",
                got="none",
                remedy="declare it, and keep it until the end",
            )
        self._told(f"{client} has control")

    def _must_hold(self, client: str) -> None:
        if client != self._holder:
            raise StateError(
                "this client has no control to give back",
                where=f"port {self.name}",
                got=client or "no client name",
                remedy="a client without control can simply end",
            )

    def _give_back(self, client: str, reason: str) -> None:
        """Take control back, if the client has it."""
        with self._lock:
            if self._holder != client:
                return
            self._holder = ""
        self._told(f"{client} {reason}; control is back")
        self.ended.set()

    def _reply(self, query: zenoh.Query, data: bytes) -> None:
        """Answer on our own key, and let go of the query: a kept one times out."""
        try:
            with query:
                query.reply(self._key, data)  # pyright: ignore[reportUnknownMemberType]
        except zenoh.ZError as error:
            logger("pbonet.master").warning("an answer could not be sent: %s", error)


def _decode(data: bytes) -> Order:
    """Return the order in `data`.

    Raises:
        ProtocolError: It is malformed, too long, or of another version.
    """
    if len(data) > codec.Codec.MAX_BYTES:
        raise ProtocolError(
            "the message is too long",
            expected=f"at most {codec.Codec.MAX_BYTES} bytes",
            got=f"{len(data)} bytes",
            remedy="send a shorter command",
        )
    try:
        order = _ORDER.decode(data)
    except codec.MALFORMED as error:
        raise ProtocolError(
            "the message is not understood",
            got=str(error),
            remedy="see docs/commands.md for its fields",
        ) from None
    if order.v != m.VERSION:
        raise ProtocolError(
            "the message is of another protocol version",
            expected=f"version {m.VERSION}",
            got=f"version {order.v}",
            remedy="run the same pbonet version on both sides",
        )
    if not order.command and not order.line.strip():
        raise ProtocolError(
            "the message has neither a command nor a line",
            remedy="give 'command' with its 'args', or a 'line'; see docs/commands.md",
        )
    if order.client and not _CLIENT.fullmatch(order.client):
        raise ProtocolError(
            "this is not a valid name for a client",
            expected="1 to 64 letters, digits, '_', '-' and '.'",
            got=repr(order.client[:40]),
            remedy="choose another name",
        )
    return order
