"""Links that are cut: those that tell nothing, and to a router that is not the nearest.

Which, and when.
"""

from __future__ import annotations

import contextlib
import os
import socket
from types import SimpleNamespace

import msgspec
import pytest
import zenoh
from watching import wait_for
from xm_rig import agent_info

from pbonet.node.agent import link_watchdog
from pbonet.node.agent.link_watchdog import AWAY, STEADY, NearestRouter
from pbonet.xm.net import client_of_router, run_folder, session

ZID = "aa"


def agent(name="arm1", zid=ZID):
    return agent_info(name, host="b", machine="m", pid=os.getpid(), zid=zid)


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


class Routed:
    """A client of two routers, each of which is there or not."""

    def __init__(self):
        with contextlib.ExitStack() as held:
            taken = [held.enter_context(socket.socket()) for _ in range(2)]
            for one in taken:
                one.bind(("127.0.0.1", 0))
            self.ends = [f"tcp/127.0.0.1:{one.getsockname()[1]}" for one in taken]
        self.routers = {}
        for number in range(2):
            self.start(number)
        places = run_folder.Places("d", "arm0")
        self.session = client_of_router.open_session(
            places, self.ends, position=run_folder.Position(rank=1)
        )

    def start(self, number):
        settings = session.router_settings(listen=[self.ends[number]])
        config = zenoh.Config.from_json5(msgspec.json.encode(settings).decode())
        self.routers[number] = zenoh.open(config)

    def wait_used(self, number):
        """Wait until the client has a link to this router."""
        end = link_watchdog.plain(self.ends[number])

        def used():
            found = [str(one.dst) for one in self.session.info.links()]
            return [*map(link_watchdog.plain, found)] == [end]

        wait_for(used, f"router {number}")

    def close(self):
        for one in (self.session, *self.routers.values()):
            one.close()


@pytest.fixture
def routed(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    made = Routed()
    yield made
    made.close()


def test_a_client_goes_back_to_the_nearest_router_when_nobody_needs_the_link(routed):
    """For a table its machine is lost while the link is made again."""
    needed = []
    found = NearestRouter(routed.session, routed.ends, lambda: bool(needed))
    routed.wait_used(0)
    assert not any(found.check() for _ in range(2 * STEADY)), "it is the nearest"
    routed.routers[0].close()
    routed.wait_used(1)
    assert not any(found.check() for _ in range(2 * STEADY)), "the other is away"
    routed.start(0)
    needed.append("a table")
    assert not any(found.check() for _ in range(2 * STEADY))
    needed.clear()
    asked = iter([False] * STEADY + [True])  # needed while the router was asked
    late = NearestRouter(routed.session, routed.ends, lambda: next(asked))
    assert not any(late.check() for _ in range(STEADY))
    routed.wait_used(1)
    assert [found.check() for _ in range(STEADY)] == [False] * (STEADY - 1) + [True]
    routed.wait_used(0)
    routed.routers[0].close()
    routed.wait_used(1)
    routed.start(0)
    assert not any(found.check() for _ in range(AWAY)), "not again and again"
    assert any(found.check() for _ in range(STEADY))


def test_a_link_to_another_agent_of_the_machine_is_no_link_to_a_router(made):
    link, other = made("unixsock-stream"), made()
    info = SimpleNamespace(links=lambda: [link.said])
    routers = [other.said.dst, "tcp/127.0.0.1:1"]
    found = NearestRouter(SimpleNamespace(info=info), routers, lambda: False)
    assert not any(found.check() for _ in range(2 * STEADY))
    assert not link.cut()
