"""Links that stand and tell nothing are cut: which, and when."""

from __future__ import annotations

import contextlib
import os
import socket
from types import SimpleNamespace

import pytest

from pbonet.node.agent import link_watchdog
from pbonet.xm.net.agents import AgentInfo

ZID = "aa"


def agent(name="arm1", zid=ZID):
    return AgentInfo(
        name=name,
        domain="d",
        host="b",
        machine="m",
        core=1,
        cores=2,
        pid=os.getpid(),
        rtpu_pid=2,
        backend="fifo",
        version="0",
        python="3",
        zid=zid,
    )


class Link:
    """A connection as zenoh has one, and what its session says of it."""

    def __init__(self, listening, near, far, protocol):
        self.listening, self.near, self.far = listening, near, far
        if protocol == "unixsock-stream":
            src, dst = "b7e2", listening.getsockname()
        else:
            src, dst = (_spelled(one.getsockname()) for one in (near, far))
        self.said = SimpleNamespace(
            zid=ZID, src=f"{protocol}/{src}", dst=f"{protocol}/{dst}"
        )

    def cut(self):
        """Tell whether it was cut, for the other end."""
        self.far.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            return self.far.recv(1) == b""
        return False

    def close(self):
        for one in (self.near, self.far, self.listening):
            one.close()


def _spelled(address):
    host = f"[{address[0]}]" if ":" in address[0] else address[0]
    return f"{host}:{address[1]}"


@pytest.fixture
def made(tmp_path):
    """Make a link."""
    links = []

    def make(protocol="tcp", host="127.0.0.1"):
        family, where = socket.AF_INET, (host, 0)
        if protocol == "unixsock-stream":
            family, where = socket.AF_UNIX, str(tmp_path / f"x{len(links)}.sock")
        elif ":" in host:
            family = socket.AF_INET6
        listening = socket.socket(family)
        listening.bind(where)
        listening.listen()
        near = socket.socket(family)
        near.connect(listening.getsockname())
        links.append(Link(listening, near, listening.accept()[0], protocol))
        return links[-1]

    yield make
    for one in links:
        one.close()


def watch(*links, linked=(ZID,)):
    """Return a watch over links, and what its session says."""
    info = SimpleNamespace(
        routers_zid=lambda: list(said.linked), links=lambda: [one.said for one in links]
    )
    said = SimpleNamespace(info=info, linked=linked)
    return link_watchdog.LinkWatchdog(said), said


@pytest.mark.parametrize(
    ("protocol", "host"),
    [
        ("tcp", "127.0.0.1"),
        ("tls", "127.0.0.1"),
        ("tcp", "::1"),
        ("unixsock-stream", ""),
    ],
)
def test_the_link_to_who_is_not_seen_is_cut_and_no_other(made, protocol, host):
    link, other = made(protocol, host), made(protocol, host)
    found, _ = watch(link)
    found.met(agent(), here=True)
    for _ in range(link_watchdog.LOOKS - 1):
        assert found.cut_silent([]) == []
    assert not link.cut()
    assert found.cut_silent([]) == ["arm1"]
    assert link.cut()
    assert not other.cut()


def test_only_neighbours_that_are_not_seen_on_end(made):
    """Seen in between, of no link, of another domain: nothing is cut."""
    link = made()
    found, said = watch(link)
    for _ in range(5):
        assert found.cut_silent([]) == []  # who it is was never said
    found.met(agent(), here=False)
    for _ in range(5):
        assert found.cut_silent([]) == []
        assert [one.name for one in found.unseen([]).values()] == ["arm1"]
        assert found.cut_silent(["arm1"]) == []
        assert found.unseen(["arm1"]) == {}
    said.linked = ()
    for _ in range(5):
        assert found.cut_silent([]) == []
    assert not link.cut()


def test_a_link_has_time_to_come_back(made):
    found, _ = watch(made())
    found.met(agent(), here=False)
    first, pause = link_watchdog.LOOKS, link_watchdog.LOOKS + link_watchdog.PAUSE
    cut = [n for n in range(1, first + pause + 1) if found.cut_silent([])]
    assert cut == [first, first + pause]


def test_neighbours_that_are_remembered_are_bounded():
    found, said = watch()
    for n in range(link_watchdog.MOST + 1):
        found.met(agent(f"a{n}", f"z{n}"), here=False)
    said.linked = ("z0", "z1")
    assert [one.name for one in found.unseen([]).values()] == ["a1"]
