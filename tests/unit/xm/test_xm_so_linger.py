"""Connections of clients: who closes one does not wait for the other side."""

import contextlib
import socket
import struct

import pytest
import zenoh
from watching import free_port, wait_for

from pbonet.node.agent import link_watchdog
from pbonet.router import router_config
from pbonet.xm.net import session, so_linger

TEN_SECONDS = struct.pack("ii", 1, 10)


def lingers(one):
    """Return whether whoever closes a socket waits for the other side."""
    data = one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)
    return bool(struct.unpack("ii", data)[0])


def lingering_to(port):
    """Return for each connection of this process to a port whether it lingers."""
    return [lingers(one) for one in link_watchdog._sockets() if leads_to(one, port)]


def leads_to(one, port):
    try:
        return one.getpeername()[1] == port
    except (OSError, IndexError):  # not connected, or by a path
        return False


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_a_client_closes_a_lost_connection_at_once(host, monkeypatch):
    """Those of the program in which it is stay as they are."""
    port = free_port()
    with contextlib.ExitStack() as held:
        listener = held.enter_context(socket.create_server(("127.0.0.1", 0)))
        other = listener.getsockname()
        own = held.enter_context(socket.create_connection(other))
        own.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, TEN_SECONDS)
        where = f"tcp/{host}:{port}"
        held.enter_context(zenoh.open(router_config.read(listen=[where])))
        with monkeypatch.context() as patch:
            patch.setattr(so_linger, "end", lambda _opened: None)
            with session.client(connect=[where], local=False):
                assert lingering_to(port) == [True], "as zenoh has it"
        held.enter_context(session.client(connect=[where], local=False))
        wait_for(lambda: lingering_to(port) == [False], "the second one")
        assert lingers(own)


def test_a_connection_that_comes_after_a_loss_is_closed_at_once():
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    with contextlib.ExitStack() as held:
        with zenoh.open(router_config.read(listen=[where])):
            held.enter_context(session.client(connect=[where], local=False))
            wait_for(lambda: lingering_to(port) == [False], "the first one")
        wait_for(lambda: not lingering_to(port), "its loss")
        held.enter_context(zenoh.open(router_config.read(listen=[where])))
        wait_for(lambda: lingering_to(port) == [False], "the next one")
