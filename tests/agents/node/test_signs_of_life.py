"""Only agents that share a subsystem give each other signs of life."""

from __future__ import annotations

import os
import signal
from collections import Counter

import pytest
from nodekit import wait_gone
from watching import wait_for

from pbonet.xm.net import direct, key_expressions


@pytest.fixture
def given(nodes):
    """Three agents; how many signs of life each has given, and in which group."""
    for name in ("arm0", "arm1", "eye0"):
        nodes.agent(name)
    found = Counter()

    def take(sample):
        found[key_expressions.beat_of(str(sample.key_expr))] += 1

    keys = key_expressions.beat(nodes.domain, "*")
    declared = nodes.session.declare_subscriber(keys, direct(take))
    yield found
    declared.undeclare()


def test_those_without_a_table_give_and_hear_none(nodes, given):
    arm, cell = nodes.master("arm0", "arm"), nodes.master("eye0", "cell")
    arm.spawn("a", "counts", restart="on")
    other = nodes.master("arm1", "arm")
    other.spawn("b", "counts", out="Y1")
    both = {("arm", "arm0"), ("arm", "arm1")}
    wait_for(lambda: given.keys() == both | {("cell", "eye0")}, "signs of life of all")
    beats = {name: one._heartbeat for name, one in nodes.agents.items()}
    wait_for(lambda: beats["arm0"].partners() == {"arm1"}, "arm0 to hear arm1")
    wait_for(lambda: beats["arm1"].partners() == {"arm0"}, "arm1 to hear arm0")
    assert beats["eye0"].partners() == set()
    assert cell.status() == {}


def test_a_killed_rtpu_process_does_not_end_its_agents_signs_of_life(nodes, given):
    """Its table is closed until the agent has given it again."""
    for name in ("arm0", "arm1"):
        nodes.master(name, "arm")
    near, far = (nodes.agents[name]._heartbeat for name in ("arm0", "arm1"))
    wait_for(lambda: far.is_seen("arm0"), "arm1 to hear arm0")
    changes = []
    far._report = far._met = changes.append
    old = nodes.state("arm0").pid
    os.kill(old, signal.SIGKILL)
    wait_gone([old])
    nodes.wait_restarted("arm0", old)
    seen = given["arm", "arm0"]
    wait_for(lambda: given["arm", "arm0"] > seen + 5, "signs of life of arm0")
    assert near.groups() == {"arm"}
    assert changes == []
    assert far.is_seen("arm0")
