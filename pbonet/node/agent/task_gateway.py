"""Passes requests of the agent's tasks to other machines; see `remote_channel`.

Tasks connect through a Unix socket. For each process the agent declares a liveliness
token while it has an open connection, so that other agents drop what they hold for it
when it ends.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import PbonetError, ProtocolError, Severity
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import (
    Client,
    Declared,
    Deliveries,
    Letter,
    XmRequest,
    codec,
    key_expressions,
    messages as m,
    resource_messages as r,
)

from .stop_orders import parted

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from pathlib import Path

    import zenoh

log = logging.getLogger("pbonet.node")

CONNECTIONS = 64
"""Maximum number of connections of tasks at a time, one for each of their threads."""
LARGEST = 2 << 20
"""Maximum size of a request in bytes."""


class _Wire:
    """One connection; its answers may come from several threads."""

    def __init__(self, link: Connection) -> None:
        self.link = link
        self._guard = threading.Lock()

    def send(self, data: bytes) -> None:
        """Send an answer; drop it if it is no longer wanted."""
        with self._guard, contextlib.suppress(OSError):
            self.link.send_bytes(data)

    def end(self) -> None:
        """Let its reader see the end of the connection."""
        with contextlib.suppress(OSError):
            twin = socket.socket(fileno=os.dup(self.link.fileno()))
            with twin:
                twin.shutdown(socket.SHUT_RDWR)


class TaskGateway:
    """Receives requests of tasks and passes them on.

    Args:
        session: The agent's session.
        domain: Its domain.
        name: Its name.
        path: The socket that tasks connect to.
        note: Called with reports for masters.
        parts: See `Mail`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: str,
        name: str,
        path: Path,
        note: Callable[[rtpu_messages.Note], None],
        *,
        parts: Callable[[str, str], bool] = lambda _, __: False,
    ) -> None:
        self._domain, self._path, self._note = domain, path, note
        self._parts = parts
        self._client = Client(session, domain, f"{name}-{os.urandom(4).hex()}")
        self._codec = codec.Codec()
        self._letter = msgspec.msgpack.Decoder(Letter)
        self._guard = threading.Lock()
        self._open: set[_Wire] = set()
        self._tokens: dict[str, tuple[Declared, set[_Wire]]] = {}
        self._over = False
        self._pool = ThreadPoolExecutor(CONNECTIONS, "pbonet relay")
        path.unlink(missing_ok=True)  # of a killed agent
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(CONNECTIONS)
        self._thread = threading.Thread(
            target=self._accept, name="pbonet post", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop accepting requests."""
        self._over = True
        self._listener.shutdown(socket.SHUT_RDWR)  # wakes the accepting thread
        self._thread.join()
        self._listener.close()
        self._path.unlink(missing_ok=True)
        with self._guard:
            wires = list(self._open)
        for wire in wires:
            wire.end()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _accept(self) -> None:
        while not self._over:
            try:
                accepted, _ = self._listener.accept()
            except OSError:
                continue
            from multiprocessing.connection import Connection  # when a task asks

            link = Connection(accepted.detach())
            if len(self._open) >= CONNECTIONS:
                link.close()
                continue
            wire = _Wire(link)
            self._open.add(wire)
            threading.Thread(
                target=self._read, args=(wire,), name="pbonet letters", daemon=True
            ).start()

    def _read(self, wire: _Wire) -> None:
        """Receive the requests of one connection until it is closed."""
        client = ""
        deliveries = Deliveries(self, lambda text: self._report(client, text))
        try:
            while not self._over:
                letter = self._letter.decode(wire.link.recv_bytes(LARGEST))
                client = client or self._welcome(letter.client, wire)
                if letter.report:
                    deliveries.add(letter.rtpu, self._request(letter))
                elif letter.wait or letter.rtpu:  # else it only announces its presence
                    self._pool.submit(self._carry, wire, letter)
        except (OSError, EOFError):
            pass  # it was closed
        except (*codec.MALFORMED, PbonetError, RuntimeError) as error:
            log.warning("%s: a task's request is refused: %s", self._client.name, error)
        finally:
            deliveries.end()
            self._farewell(client, wire)
            wire.link.close()

    def _welcome(self, client: str, wire: _Wire) -> str:
        """Declare a client's token with its first connection; return the client."""
        with self._guard:
            if client not in self._tokens:
                token = self._client.announce(
                    key_expressions.customer(self._domain, client)
                )
                self._tokens[client] = token, set()
            self._tokens[client][1].add(wire)
        return client

    def _farewell(self, client: str, wire: _Wire) -> None:
        """Withdraw a client's token with its last connection."""
        with self._guard:
            self._open.discard(wire)
            token, wires = self._tokens.get(client, (None, set[_Wire]()))
            wires.discard(wire)
            if token is None or wires:
                return
            del self._tokens[client]
        with contextlib.suppress(Exception):  # the session may already be closed
            token.undeclare()

    def _carry(self, wire: _Wire, letter: Letter) -> None:
        """Pass a request on, and send the answer back."""
        try:
            data = self._passed_on(letter)
        except PbonetError as error:
            data = self._codec.pack(codec.failure(error))
        if letter.wait:
            wire.send(data)

    def _passed_on(self, letter: Letter) -> bytes:
        if not letter.rtpu:
            return msgspec.msgpack.encode(self._client.rtpus())
        request = self._request(letter)
        if not letter.wait:  # it settles or detaches: it gives back, and takes nothing
            self._client.post(letter.rtpu, request)
            return b""
        result = self.call(letter.rtpu, request, object, timeout=letter.timeout)
        return self._codec.pack(m.Answer(ok=True, result=result))

    def call(
        self, rtpu: str, request: m.Request, result: type[object], *, timeout: float
    ) -> object:
        """Return the result of a task's request.

        What a wait took from one that has missed a stop meanwhile is not used; the task
        gives it back.

        Raises:
            UnreachableError: It is not there, or missed a stop of the task's subsystem.
            PbonetError: It refuses.
        """
        self._must_not_be_apart(rtpu, request)
        found = self._client.call(rtpu, request, result, timeout=timeout)
        if isinstance(request, r.Take):
            self._must_not_be_apart(rtpu, request)
        return found

    def _must_not_be_apart(self, rtpu: str, request: m.Request) -> None:
        if request.subsystem and self._parts(request.subsystem, rtpu):
            raise parted(rtpu)

    def _request(self, letter: Letter) -> XmRequest:
        request = self._codec.request(letter.data)
        if not isinstance(request, XmRequest):
            raise ProtocolError(
                "tasks may only use resources of other machines",
                expected="a request about a semaphore, a queue, or a file",
                got=type(request).__name__.lower(),
                remedy="send commands with a master",
            )
        request.client = letter.client
        return request

    def _report(self, client: str, text: str) -> None:
        text = f"task process {client.split('-')[-2]}: {text}"
        self._note(rtpu_messages.Note(int(Severity.WARNING), "NOT_DELIVERED", text))
