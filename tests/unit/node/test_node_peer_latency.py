"""The version of table packets that all agents in sight understand."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pbonet.node.agent import peer_latency
from pbonet.node.agent.peer_latency import PeerLatencies
from pbonet.versions import Range
from pbonet.xm.net import AgentInfo, session

VERSIONS = {"table": Range(1, 2)}


def agent(name="arm1", **more):
    return AgentInfo(
        name=name,
        domain="d",
        host="b",
        machine="m",
        core=1,
        cores=2,
        pid=1,
        rtpu_pid=2,
        backend="fifo",
        version="0",
        python="3",
        zid="aa",
        **more,
    )


class World:
    """The other agents, as arm0 sees them."""

    def __init__(self, monkeypatch):
        self.there = [agent(versions=VERSIONS)]
        link = SimpleNamespace(info=SimpleNamespace(routers_zid=list, links=list))
        self.ways = PeerLatencies(link, lambda: agent("arm0"))
        monkeypatch.setattr(self.ways, "_ask", self._ask)
        monkeypatch.setattr(peer_latency, "LAYERS", VERSIONS)
        monkeypatch.setattr(
            session, "rtpus", lambda *_: [one.name for one in self.there]
        )
        self.ways._table_version = 1

    def _ask(self, key):
        return next(one for one in self.there if f"/{one.name}/" in key)

    def measure(self):
        """Make a round trip to each agent that has appeared, and the others."""
        self.ways._new.clear()
        self.ways._measure("arm0")


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


def test_a_report_of_the_last_round_trips_sends_none(world):
    world.measure()
    world.there = []  # an answer would be missed
    report = world.ways.report(measure=False)
    assert [(way.rtpu, way.error) for way in report.ways] == [("arm1", "")]
