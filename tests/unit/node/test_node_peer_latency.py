"""Which agents are asked, and the version of tables that those known understand."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import zenoh
from xm_rig import agent_info

from pbonet.node.agent import peer_latency
from pbonet.node.agent.peer_latency import (
    ASKED,
    FRESH_NS,
    WATCHED,
    PeerLatencies,
    watched_agents,
)
from pbonet.versions import Range
from pbonet.xm.net import key_expressions, session

VERSIONS = {"table": Range(1, 2)}


def agent(name="arm1", **more):
    return agent_info(name, host="b", machine="m", zid="aa", **more)


class World:
    """The other agents, as arm0 sees them."""

    def __init__(self, monkeypatch):
        self.there = [agent(versions=VERSIONS)]
        link = SimpleNamespace(info=SimpleNamespace(routers_zid=list, links=list))
        self.ways = PeerLatencies(link, agent("arm0"), partners=lambda: {"arm1"})
        monkeypatch.setattr(self.ways, "_ask", self._ask)
        monkeypatch.setattr(peer_latency, "LAYERS", VERSIONS)
        self.ways._table_version = 1

    def _ask(self, key):
        return next(one for one in self.there if f"/{one.name}/" in key)

    def measure(self):
        """Make a round trip to each agent that has appeared, and the others."""
        self.ways._alive = {one.name for one in self.there}
        self.ways._ask_due()


@pytest.fixture
def world(monkeypatch):
    return World(monkeypatch)


def test_an_agent_that_was_out_of_sight_may_have_another_version(world):
    world.measure()
    assert world.ways.table_version() == 2
    world.ways.out_of_sight("arm1")
    world.there = [agent()]
    world.ways.in_sight("arm1")
    assert world.ways.table_version() == 1, "it has not told its own yet"
    world.measure()
    assert world.ways.table_version() == 1
    world.there = [agent(versions=VERSIONS)]
    world.measure()
    assert world.ways.table_version() == 2


def test_one_that_joins_a_group_speaks_the_oldest_version_until_all_are_heard(
    world, monkeypatch
):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    world.measure()
    assert world.ways.table_version() == 2
    world.ways.expect_others()
    world.measure()
    assert world.ways.table_version() == 1, "an older one may not have been heard"
    now[0] += session.SILENT_MS * 1e-3
    world.measure()
    assert world.ways.table_version() == 2


def test_a_report_of_the_last_round_trips_sends_none(world):
    world.measure()
    world.there = []  # an answer would be missed
    report = world.ways.report(measure=False)
    assert [(way.rtpu, way.error) for way in report.ways] == [("arm1", "")]


class Fleet:
    """A hundred agents, as arm0 sees them; it shares a subsystem with two."""

    def __init__(self, partners=("b1", "b2"), **how):
        self.names = [f"b{n}" for n in range(100)]
        self.linked, self.asked, self.heard = [], [], []
        link = SimpleNamespace(
            info=SimpleNamespace(routers_zid=lambda: self.linked, links=list)
        )
        listener = SimpleNamespace(
            met=lambda info: self.heard.append(("met", info.name)),
            lost=lambda name: self.heard.append(("lost", name)),
            dropped=lambda name: self.heard.append(("dropped", name)),
        )
        self.ways = PeerLatencies(
            link,
            agent("arm0"),
            listeners=(listener,),
            partners=lambda: set(partners),
            **how,
        )
        self.ways._ask = self._ask
        for name in self.names:
            self.token(name)

    def _ask(self, key):
        name = key_expressions.rtpu_name(key)
        self.asked.append(name)
        info = agent(name)
        info.zid, info.machine = f"z-{name}", f"m-{name}"
        return info

    def token(self, name, kind=zenoh.SampleKind.PUT):
        key = key_expressions.rtpu("d", name, "alive")
        self.ways._on_token(SimpleNamespace(key_expr=key, kind=kind))

    def second(self):
        """Return which agents are asked in a second."""
        self.asked.clear()
        self.ways._ask_due()
        return sorted(self.asked)


def test_partners_are_asked_each_second_and_a_few_others_in_turn():
    fleet = Fleet()
    watched = watched_agents("arm0", fleet.names, WATCHED)
    assert fleet.second() == sorted({"b1", "b2", *watched})
    later = [set(fleet.second()) - {"b1", "b2"} for _ in range(WATCHED // ASKED)]
    assert [len(one) for one in later] == [ASKED] * len(later)
    assert set().union(*later) == {*watched}
    ways = fleet.ways.report(measure=False)
    assert {way.rtpu for way in ways.ways} == {"b1", "b2", *watched}
    assert ways.alive == 100


def test_each_agent_is_watched_by_as_many_as_it_watches():
    names = [f"arm{n}" for n in range(40)]
    seen = [one for me in names for one in watched_agents(me, {*names} - {me}, WATCHED)]
    assert {seen.count(name) for name in names} == {WATCHED}
    few = watched_agents("arm0", ["arm2", "arm1"], WATCHED)
    assert sorted(few) == ["arm1", "arm2"], "of few agents all"
    assert len(watched_agents("arm0", names[1:], None)) == 39, "a gateway watches all"


def test_what_is_known_of_strangers_is_dropped():
    partners = ["b1", "b2"]
    fleet = Fleet(partners)
    fleet.second()
    partners.clear()
    watched = watched_agents("arm0", fleet.names, WATCHED)
    gone = {"b1", "b2"} - {*watched}
    fleet.ways._partners = set
    fleet.second()
    assert {("dropped", name) for name in gone} == {
        one for one in fleet.heard if one[0] == "dropped"
    }
    assert {*fleet.ways._peers} == {*watched}
    assert fleet.ways.lost() == []


def test_an_agent_that_announces_a_change_is_asked_by_those_that_know_it():
    fleet = Fleet()
    fleet.second()
    fleet.asked.clear()
    watched = watched_agents("arm0", fleet.names, WATCHED)
    stranger = next(n for n in fleet.names if n not in {"b1", "b2", *watched})
    for name in (watched[0], stranger):
        key = key_expressions.rtpu("d", name, "changed")
        fleet.ways._on_change(SimpleNamespace(key_expr=key))
    fleet.ways._ask_new()
    assert fleet.asked == [watched[0]]


def test_the_loss_of_a_watched_agent_is_told_and_its_place_is_taken():
    fleet = Fleet(())
    fleet.second()
    first = watched_agents("arm0", fleet.names, WATCHED)
    fleet.token(first[0], zenoh.SampleKind.DELETE)
    fleet.names.remove(first[0])
    asked = fleet.second()
    assert [one.rtpu for one in fleet.ways.lost()] == [first[0]]
    (new,) = {*watched_agents("arm0", fleet.names, WATCHED)} - {*first}
    assert new in asked
    fleet.token(first[0])
    fleet.ways._ask_new()
    assert fleet.ways.lost() == []
    assert fleet.asked[-1] == first[0], "at once"


def test_a_neighbour_is_looked_for_until_it_is_known():
    """To cut a link that tells nothing, who is at its end must be known."""
    fleet = Fleet(())
    fleet.second()
    watched = watched_agents("arm0", fleet.names, WATCHED)
    far = sorted({*fleet.names} - {*watched})[7]
    fleet.linked = [f"z-{far}", "a router that is no agent"]
    for _ in range(100 // ASKED):
        fleet.second()
    assert {*fleet.ways._peers} == {*watched, far}
    assert len(fleet.second()) == ASKED, "each is asked once"


def test_the_offset_of_one_round_trip_is_not_recorded_for_ever(monkeypatch):
    """A clock drifts, and a neighbour that shares nothing is asked once."""
    at = [10**9]
    monkeypatch.setattr("time.monotonic_ns", lambda: at[0])
    fleet = Fleet(())
    fleet.second()
    watched = watched_agents("arm0", fleet.names, WATCHED)
    far = min({*fleet.names} - {*watched})
    fleet.linked = [f"z-{far}"]
    for _ in range(2):
        fleet.second()

    def recorded():
        return {one.rtpu for one in fleet.ways._apart()}

    assert recorded() == {*watched, far}
    at[0] += FRESH_NS
    for _ in range(WATCHED // ASKED):
        fleet.second()
    assert recorded() == {*watched}
    assert far in fleet.ways._peers


def test_who_is_a_client_of_a_router_looks_for_no_neighbour():
    """A router is no agent, and nobody's answer would make it known."""
    fleet = Fleet((), by_router=True)
    fleet.linked = ["a router that is no agent"]
    fleet.second()
    assert len(fleet.second()) == ASKED


def test_a_token_must_be_missed_twice(monkeypatch):
    """A search beside a subscriber may miss one."""
    fleet = Fleet(())
    found = [*fleet.names, "new"]
    monkeypatch.setattr(session, "rtpus", lambda *_: found)
    found.remove("b7")
    fleet.ways._check_tokens()
    assert fleet.ways._alive == {*fleet.names, "new"}
    fleet.ways._check_tokens()
    assert fleet.ways._alive == {*found}


def test_an_agent_that_goes_while_tokens_are_sought_stays_gone(monkeypatch):
    fleet = Fleet(())

    def rtpus(*_):
        fleet.token("b7", zenoh.SampleKind.DELETE)
        return fleet.names

    monkeypatch.setattr(session, "rtpus", rtpus)
    fleet.ways._check_tokens()
    assert fleet.ways._alive == {*fleet.names} - {"b7"}
    fleet.token("b7")
    monkeypatch.setattr(session, "rtpus", lambda *_: fleet.names)
    fleet.ways._check_tokens()
    assert fleet.ways._alive == {*fleet.names}
