"""Requests of a process to other machines for their resources.

A task sends them to its agent through a Unix socket; its process has no network code.
Every other process is a client of the agents, like all tools. Both declare a liveliness
token for their lifetime, so that agents drop what they hold for a process that ended.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import select
import sys
import threading
from typing import TYPE_CHECKING, Protocol, TypeVar

import msgspec

from pbonet.errors import NoAnswerError, UnreachableError, XmError, XmFullError
from pbonet.outside import Outside, active
from pbonet.xm.net import (
    Letter,
    codec,
    key_expressions,
    read_names,
    read_result,
    run_folder,
)

from . import names

if TYPE_CHECKING:
    from collections.abc import Sequence
    from multiprocessing.connection import Connection
    from pathlib import Path

    from pbonet.xm.net import Client, Declared, Request

T = TypeVar("T")

CONNECT = "PBONET_CONNECT"
"""Variable with the endpoints of agents on other machines, separated by blanks."""


class Carrier(Protocol):
    """Sends requests to agents and returns their answers."""

    name: str
    """The client's name, as in its token."""

    def call(
        self, rtpu: str, request: Request, result: type[T], *, timeout: float = ...
    ) -> T:
        """Return the result of a request; see `pbonet.xm.net.rpc.Client.call`."""
        ...

    def post(self, rtpu: str, request: Request) -> None:
        """Send a request without waiting for an answer."""

    def deliver(self, rtpu: str, request: Request) -> None:
        """Send a request after those before it, without waiting; report a failure."""

    def rtpus(self) -> list[str]:
        """Return the names of the RTPUs whose agents are alive."""
        ...

    def close(self) -> None:
        """Close; agents drop what they hold for this process."""


class RemoteChannel:
    """Sends a task's requests to its RTPU's agent, which passes them on.

    Every thread has its own connection, and the process one more, without requests:
    when the last one closes, the agent drops what it holds for the process.

    Args:
        path: The agent's socket.
        rtpu: The agent's RTPU.
        subsystem: The task's subsystem.
    """

    def __init__(self, path: str, rtpu: str, subsystem: str) -> None:
        from multiprocessing import connection  # only where a task needs it

        self.name = f"{rtpu}-{os.getpid()}-{os.urandom(4).hex()}"
        self._connect = connection.Client
        self._path, self._rtpu, self._subsystem = path, rtpu, subsystem
        self._codec = codec.Codec()
        self._own = threading.local()
        self._guard = threading.Lock()
        self._anchor: Connection | None = None

    def call(
        self, rtpu: str, request: Request, result: type[T], *, timeout: float = 2.0
    ) -> T:
        """Return the result of a request; see `pbonet.xm.net.rpc.Client.call`."""
        data = self._pack(request)
        answer = self._exchange(Letter(self.name, rtpu, timeout, data))
        return read_result(rtpu, self._codec.answer(answer), result)

    def post(self, rtpu: str, request: Request) -> None:
        """Send a request; the agent passes it on."""
        data = self._pack(request)
        self._exchange(Letter(self.name, rtpu, 0.0, data, wait=False))

    def deliver(self, rtpu: str, request: Request) -> None:
        """Send a request, which the agent delivers in order; it reports a failure.

        Raises:
            XmFullError: The agent does not read what the task sends.
        """
        data = self._pack(request)
        self._exchange(Letter(self.name, rtpu, 0.0, data, wait=False, report=True))

    def rtpus(self) -> list[str]:
        """Return the names of the RTPUs whose agents are alive."""
        return read_names(self._exchange(Letter(self.name, "", 0.0, b"")))

    def close(self) -> None:
        """Close; agents drop what they hold for this process."""
        self._forget()
        with self._guard:
            anchor, self._anchor = self._anchor, None
            if anchor is not None:
                anchor.close()

    def _pack(self, request: Request) -> bytes:
        request.client, request.subsystem = self.name, self._subsystem
        return self._codec.pack(request)

    def _exchange(self, letter: Letter) -> bytes:
        try:
            link = self._link()
            if letter.report:
                _must_have_room(link, self._rtpu)
            link.send_bytes(msgspec.msgpack.encode(letter))
            return link.recv_bytes() if letter.wait else b""
        except (OSError, EOFError) as error:
            self._forget()
            with self._guard:
                self._anchor = None  # its agent has ended
            raise UnreachableError(
                "the task's own agent cannot be reached",
                where=self._rtpu,
                got=str(error) or type(error).__name__,
                remedy=f"start it again: pbonet agent --name {self._rtpu}",
            ) from None
        except BaseException:  # a signal handler raised: an answer may be under way
            self._forget()
            raise

    def _link(self) -> Connection:
        link: Connection | None = getattr(self._own, "link", None)
        if link is None:
            with self._guard:
                if self._anchor is None:
                    self._anchor = self._connect(self._path, "AF_UNIX")
                    here = Letter(self.name, "", 0.0, b"", wait=False)
                    self._anchor.send_bytes(msgspec.msgpack.encode(here))
            link = self._own.link = self._connect(self._path, "AF_UNIX")
        return link

    def _forget(self) -> None:
        link: Connection | None = self._own.__dict__.pop("link", None)
        if link is not None:
            link.close()


def _must_have_room(link: Connection, rtpu: str) -> None:
    """Refuse to wait: a socket that can be written to has most of its room free."""
    poll = select.poll()
    poll.register(link.fileno(), select.POLLOUT)
    if poll.poll(0):
        return
    raise XmFullError(
        "the task's own agent does not read what the task sends to other machines",
        where=rtpu,
        got="a full socket: the agent is stopped, or has no time",
        remedy="send less often; see whether the agent runs: pbonet status",
    )


_guard = threading.Lock()
_carrier: Carrier | None = None
_forked = False


def _after_fork() -> None:
    global _carrier, _forked, _guard  # noqa: PLW0603 - a process has one carrier
    _forked = _forked or "zenoh" in sys.modules
    _carrier, _guard = None, threading.Lock()


os.register_at_fork(after_in_child=_after_fork)


def carrier() -> Carrier:
    """Return this process's carrier, made on first use.

    Raises:
        UnreachableError: No agent can be reached.
        XmError: The process was forked from one that had used the network.
    """
    global _carrier  # noqa: PLW0603 - a process has one carrier
    with _guard:
        if _carrier is None:
            _carrier = _make()
        return _carrier


def _make() -> Carrier:
    home = names.home()
    if home.subsystem:
        path = run_folder.Places(home.domain, home.rtpu).post
        return RemoteChannel(str(path), home.rtpu, home.subsystem)
    return client(home.domain)


def client(
    domain: str, *, connect: Sequence[str] = (), key_folder: Path | None = None
) -> Carrier:
    """Open a client of the agents, as tools do.

    Args:
        domain: Domain of the agents.
        connect: Endpoints of agents; by default those in `PBONET_CONNECT`.
        key_folder: Keys of the client; by default those in `PBONET_KEYS`.

    Raises:
        UnreachableError: No agent can be reached.
        XmError: The process was forked from one that had used the network.
    """
    from pbonet.xm.net import Client, session

    if _forked:
        raise XmError(
            "a forked process cannot use the network",
            got="a parent that had used it",
            remedy="start it with multiprocessing's method 'spawn', or with subprocess",
        )
    endpoints = list(connect) or os.environ.get(CONNECT, "").split()
    try:
        opened = session.client(domain, connect=endpoints, key_folder=key_folder)
    except UnreachableError as error:
        if not endpoints:
            error.remedy += f"; a program sets {CONNECT} instead"
        raise
    made = Client(opened, domain, f"p{os.getpid()}-{os.urandom(4).hex()}")
    token = made.announce(key_expressions.customer(domain, made.name))
    atexit.register(_end, made, token)  # also keeps the token alive
    return made


def _end(client: Client, token: Declared) -> None:
    with contextlib.suppress(Exception):  # the process is about to end
        token.undeclare()
        client.close()


def alive(rtpu: str) -> bool:
    """Return whether an RTPU's agent is alive (``xmAlive``, section 5.3.1).

    For an agent on this machine no network is needed.

    Raises:
        UnreachableError: No agent at all can be reached.
    """
    run_folder.check_name("an RTPU", rtpu)
    if active():
        return Outside(f"agent {rtpu}").ask(_alive, rtpu)
    return _alive(rtpu)


def _alive(rtpu: str) -> bool:
    domain = names.home().domain
    if rtpu in run_folder.live_agents(domain):
        return True
    try:
        return rtpu in carrier().rtpus()
    except NoAnswerError:
        return False
