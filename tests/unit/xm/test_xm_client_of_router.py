"""Ranks of the agents of one machine, and sessions that are clients and have some."""

import json
import re
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import zenoh
from long_limits import LIMIT
from watching import wait_for

from pbonet.errors import NodeError
from pbonet.xm.net import client_of_router, dialling, run_folder, session

with socket.socket() as _one:
    _one.bind(("127.0.0.1", 0))
    ROUTER = f"tcp/127.0.0.1:{_one.getsockname()[1]}"
"""Where a router may be; most of the time there is none."""


@pytest.fixture
def _folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))


@pytest.fixture
def opened(_folder):
    """Starts the sessions of agents; returns a session by its name."""
    kept = {}

    def start(name, *, routed=True, reached=False):
        places = run_folder.Places("d", name)
        lock, position = client_of_router.take_place(
            places, f"agent, process {ord(name)}", routed=routed, reached=reached
        )
        if position.rank:
            routers = [ROUTER] if position.place is None else []
            link = client_of_router.open_session(places, routers, position=position)
        else:
            link = dialling.Dialled(places, place=position.place).session
        key = f"pbonet/d/rtpu/{name}/alive"
        token = link.liveliness().declare_token(key)
        kept[name] = (link, lock, token, places)
        return position

    def end(name):
        link, lock, _, places = kept.pop(name)
        link.close()
        places.remove(*places.agents_files)
        lock.release()
        run_folder.sweep_routers("d")

    start.end = end
    start.sees = lambda name: session.rtpus(kept[name][0], "d")
    start.link = lambda name: kept[name][0]
    yield start
    for name in list(kept):
        end(name)
    left = [path.name for path in run_folder.folder().rglob("*") if path.is_file()]
    assert not left


def all_see(opened, *names):
    for name in names:
        wait_for(lambda n=name: opened.sees(n) == sorted(names), f"all from {name}")


def test_agents_without_a_router_see_each_other(opened):
    """And a program that connects to any of them sees all."""
    assert [opened(name).rank for name in "abc"] == [1, 2, 3]
    all_see(opened, *"abc")
    for name in "abc":
        where = [run_folder.Places("d", name).endpoint]
        with session.client("d", connect=where, timeout=LIMIT, local=False) as link:
            wait_for(lambda s=link: session.rtpus(s, "d") == list("abc"), "all")


def test_they_end_and_start_in_any_order(opened):
    """Each joins the others, and none is in a circle that misses a router."""
    for name in "abc":
        opened(name)
    for name in "abaccb":
        opened.end(name)
        assert opened(name).rank > 2
        all_see(opened, *"abc")
    settings = session.router_settings(listen=[ROUTER])
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        with session.client("d", connect=[ROUTER], timeout=LIMIT, local=False) as link:
            wait_for(lambda: session.rtpus(link, "d") == list("abc"), "all by it")
        for name in "ab":
            opened.end(name)
        opened("b")
        all_see(opened, *"bc")
        with session.client("d", connect=[ROUTER], timeout=LIMIT, local=False) as link:
            wait_for(lambda: session.rtpus(link, "d") == list("bc"), "both by it")
    all_see(opened, *"bc")


def test_one_without_routers_joins(opened):
    opened("a")
    assert opened("b", routed=False) == (2, None)
    all_see(opened, *"ab")


@pytest.fixture
def star(opened, monkeypatch):
    """Starts agents of a machine that has no routers, of which one is a router."""
    monkeypatch.setattr(client_of_router, "HERE", 1)

    def start(name, *, reached=False):
        return opened(name, routed=False, reached=reached)

    start.sees, start.end, start.link = opened.sees, opened.end, opened.link
    return start


def test_further_agents_of_a_machine_are_clients_of_the_first(star):
    assert [star(name) for name in "abc"] == [(0, 1), (1, 0), (2, 0)]
    all_see(star, *"abc")


def test_the_router_of_a_machine_ends_and_another_agent_takes_its_place(star):
    """Meanwhile the others see each other, and the next agent links them again."""
    for name in "abc":
        star(name)
    star.end("a")
    all_see(star, *"bc")
    assert star("d") == (0, 1)
    all_see(star, *"bcd")
    assert star("a") == (3, 0)
    all_see(star, *"abcd")


def test_a_client_knows_the_process_by_which_it_is_linked(star, monkeypatch):
    """At a place, and after its end an agent of lesser rank; a router has none."""
    monkeypatch.setattr(client_of_router, "NEIGHBOUR_TIME", 0.0)
    for name in "abc":
        star(name)
    above = {name: client_of_router.Neighbour(star.link(name), "d") for name in "abc"}

    def found(name):
        return list(above[name].processes())

    folder = run_folder.folder()
    folder.chmod(0o755)
    assert found("b") == []
    folder.chmod(0o700)
    assert [found(name) for name in "abc"] == [[], [ord("a")], [ord("a")]]
    star.end("a")
    wait_for(lambda: found("c") == [ord("b")] and not found("b"), "another link")
    star("d")
    wait_for(lambda: found("b") == [ord("d")], "the link with the next router")


def test_an_agent_that_others_reach_is_a_router_though_there_is_one(star):
    assert [star("a"), star("b", reached=True)] == [(0, 1), (0, 2)]
    assert star("c") == (1, 0)
    all_see(star, *"abc")
    star.end("a")
    all_see(star, *"bc")


def test_clients_of_a_machine_without_routers_are_no_clients_of_others(star):
    """An agent with routers beside them would be linked with these alone."""
    star("a")
    star("b")
    star.end("a")
    with pytest.raises(NodeError, match=re.escape("none for b); give them")):
        client_of_router.position_of("d", "c", routed=True)


@pytest.mark.usefixtures("_folder")
def test_agents_that_start_at_one_time_have_different_ranks():
    """As they do with their machine: of equal rank they would not see each other."""
    places = [run_folder.Places("d", f"a{number}") for number in range(16)]
    together = threading.Barrier(len(places))

    def start(place):
        together.wait()
        return client_of_router.take_place(place, "agent", routed=True)

    with ThreadPoolExecutor(len(places)) as pool:
        taken = list(pool.map(start, places))
    for lock, _ in taken:
        lock.release()
    assert sorted(its.rank for _, its in taken) == list(range(1, len(places) + 1))


@pytest.mark.usefixtures("_folder")
def test_alone_without_routers_is_no_client():
    assert client_of_router.position_of("d", "a", routed=False) == (0, 1)


@pytest.mark.usefixtures("_folder")
def test_routers_beside_agents_that_have_none():
    places = run_folder.Places("d", "old")
    lock = run_folder.NameLock(places.lock, "agent old, process 1")
    try:
        with pytest.raises(NodeError, match=re.escape("none for old); give them")):
            client_of_router.position_of("d", "a", routed=True)
        assert client_of_router.position_of("d", "old", routed=True) == (1, None)
    finally:
        lock.release()


def test_a_stranger_is_no_client(opened):
    """A zenoh client must say that it is one: it might be an agent of lesser rank."""
    opened("a")
    where = run_folder.Places("d", "a").endpoint
    config = zenoh.Config.from_json5(
        f'{{mode: "client", connect: {{endpoints: ["{where}"], timeout_ms: 0}},'
        "scouting: {multicast: {enabled: false}}}"
    )
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)
