"""Connections whose retransmissions and whose end are looked after: which."""

import contextlib
import fcntl
import os
import socket
import struct
import sys

import zenoh
from watching import free_port, wait_for

from pbonet.node.agent import link_watchdog, retransmission
from pbonet.router import router_config, router_process
from pbonet.xm.net import session

NOT_SENT = 0x894B
"""SIOCOUTQNSD: the bytes in a socket that were not sent yet."""
ROOM = 1 << 20
MOST_APPENDED = retransmission.UNSENT + (1 << 16)
"""What the kernel may append to the last buffer, in addition to the limit."""


def limit(one):
    return one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT)


def lingers(one):
    """Return whether whoever closes a socket waits for the other side."""
    data = one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)
    return bool(struct.unpack("ii", data)[0])


def let_linger(one):
    """Have whoever closes a socket wait, as zenoh does."""
    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))


def lingering():
    """Return how many sockets of this process are of that kind."""
    return sum(map(lingers, link_watchdog._sockets()))


def test_a_lost_connection_is_closed_at_once():
    """zenoh's thread would wait for the other side, and accept no link meanwhile."""
    with contextlib.ExitStack() as held:
        listener = held.enter_context(socket.create_server(("127.0.0.1", 0)))
        one = held.enter_context(socket.create_connection(listener.getsockname()))
        held.enter_context(listener.accept()[0])
        let_linger(one)
        found = retransmission.Retransmission()
        found.find()
        assert not lingers(one)
        let_linger(one)  # with TLS, zenoh does so after the greeting
        found.find()
        assert not lingers(one)


def test_a_router_closes_lost_connections_at_once():
    """Those that were there when it began, and those that come later."""
    where = f"tcp/127.0.0.1:{free_port()}"
    with contextlib.ExitStack() as held:
        router = held.enter_context(zenoh.open(router_config.read(listen=[where])))
        held.enter_context(session.client(connect=[where], local=False))
        assert lingering(), "as zenoh has it"
        held.enter_context(router_process.tended(router))
        wait_for(lambda: not lingering(), "the first one")
        held.enter_context(session.client(connect=[where], local=False))
        wait_for(lambda: not lingering(), "the second one")


def test_a_new_connection_with_the_descriptor_of_the_last_one_is_found():
    """A link that is lost is dialled again at once, and gets the same number."""
    found = retransmission.Retransmission()
    with contextlib.ExitStack() as held:
        listener = held.enter_context(socket.create_server(("127.0.0.1", 0)))
        one = held.enter_context(socket.create_connection(listener.getsockname()))
        held.enter_context(listener.accept()[0])
        found.find()
        assert limit(one) == retransmission.UNSENT
        other = socket.create_connection(listener.getsockname())
        held.enter_context(listener.accept()[0])
        number = one.detach()
        os.dup2(other.fileno(), number)  # closes the first one
        other.close()
        again = held.enter_context(socket.socket(fileno=number))
        assert limit(again) != retransmission.UNSENT
        found.find()
        assert limit(again) == retransmission.UNSENT


def test_little_waits_in_a_socket():
    """Else old values would come first after an interruption, by the megabyte."""
    with contextlib.ExitStack() as held:
        listener = held.enter_context(socket.create_server(("127.0.0.1", 0)))
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        one = held.enter_context(socket.create_connection(listener.getsockname()))
        held.enter_context(listener.accept()[0])  # reads nothing
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ROOM)
        retransmission.Retransmission().find()
        one.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                one.send(bytes(1000))
        found = fcntl.ioctl(one, NOT_SENT, bytes(4))
    assert 0 < int.from_bytes(found, sys.byteorder) < MOST_APPENDED
