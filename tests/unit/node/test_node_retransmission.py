"""Connections whose retransmissions are looked after: which."""

import contextlib
import os
import socket

from pbonet.node.agent import retransmission


def limit(one):
    return one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT)


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
