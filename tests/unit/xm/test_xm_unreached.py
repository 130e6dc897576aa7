"""Why nobody answers at an endpoint: what is told, and what to do."""

import socket

import pytest

from pbonet.xm.net import probe_endpoint

LISTENS = "is an agent running there, and does it listen on that address?"


def closed():
    """Return a port that nobody listens on, and whoever keeps it so."""
    held = socket.socket()
    held.bind(("127.0.0.1", 0))
    return held


def test_a_port_that_nobody_listens_on() -> None:
    with closed() as held:
        end = f"tcp/127.0.0.1:{held.getsockname()[1]}#iface=lo"
        told = probe_endpoint.reasons([end])
    assert told == ("from 127.0.0.1: Connection refused", LISTENS)


def test_a_port_on_which_no_agent_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        told = probe_endpoint.reasons([f"tls/localhost:{other.getsockname()[1]}"])
    assert told == ("an open port, but no agent answers there", LISTENS)


@pytest.mark.parametrize("protocol", ["tcp", "udp", "ws"])
def test_a_host_that_nobody_knows(monkeypatch, protocol) -> None:
    def unknown(*_args, **_kwargs):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    got, remedy = probe_endpoint.reasons([f"{protocol}/lab7:7447"])
    assert got == "the host name lab7 is unknown"
    assert remedy.startswith("is the name right?")


def test_a_host_that_is_silent(monkeypatch) -> None:
    def silent(_where, limit):
        raise TimeoutError(limit)

    monkeypatch.setattr(socket, "create_connection", silent)
    told = probe_endpoint.reasons(["tcp/[::1]:7447"])
    assert told == ("no answer from the host ::1 within 0.5 s", LISTENS)


def test_each_of_several_is_told_and_what_to_do_once() -> None:
    got, remedy = probe_endpoint.reasons(["udp/127.0.0.1:9", "udp/127.0.0.2:9"])
    assert got == "udp/127.0.0.1:9: no answer; udp/127.0.0.2:9: no answer"
    assert remedy == LISTENS
    assert probe_endpoint.reasons(["unixsock-stream//run/x.sock"])[0] == "no answer"
