"""Which agents are out of sight, by their signs of life."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pbonet.node.agent.heartbeat import FORGET, Change, Heartbeat
from pbonet.xm.net import session

SILENT = session.SILENT_MS * 1e-3


@pytest.fixture
def now(monkeypatch):
    """The time, in a list so that a test can set it."""
    clock = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    return clock


@pytest.fixture
def changes():
    return []


@pytest.fixture
def beats(now, changes):  # noqa: ARG001 - the time is set for it
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    return Heartbeat(None, me, changes.append)


def sample(name, machine):
    payload = SimpleNamespace(to_bytes=machine.encode)
    return SimpleNamespace(key_expr=f"pbonet/d/rtpu/{name}/beat", payload=payload)


def test_who_is_heard_is_in_sight(beats, now, changes) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += SILENT / 2
    beats._check(now[0])
    assert not beats.is_silent("arm1")
    assert not beats.is_silent("nobody")
    assert not changes


def test_who_is_silent_goes_out_of_sight_once_and_comes_back(
    beats, now, changes
) -> None:
    beats._note_beat(sample("arm1", "m"))
    for _ in range(3):
        now[0] += SILENT
        beats._check(now[0])
    assert changes == [Change("arm1", "m", seen=False, last=True)]
    assert beats.is_silent("arm1")
    beats._note_beat(sample("arm1", "m"))
    beats._note_beat(sample("arm1", "m"))
    assert changes[1:] == [Change("arm1", "m", seen=True, last=False)]
    assert not beats.is_silent("arm1")


def test_a_machine_is_lost_with_the_last_of_its_agents(beats, now, changes) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += SILENT / 2
    beats._note_beat(sample("arm2", "m"))
    beats._note_beat(sample("arm3", "other"))
    now[0] += SILENT / 2
    beats._check(now[0])
    now[0] += SILENT / 2
    beats._note_beat(sample("arm3", "other"))
    beats._check(now[0])
    assert changes == [
        Change("arm1", "m", seen=False, last=False),
        Change("arm2", "m", seen=False, last=True),
    ]


def test_silence_is_that_of_the_whole_machine(beats, now) -> None:
    now[0] += 3.0
    assert beats.silence("arm1") == 3.0, "never heard: since the start"
    beats._note_beat(sample("arm1", "m"))
    now[0] += 1.0
    assert beats.silence("arm1") == 1.0
    beats._note_beat(sample("arm2", "m"))
    beats._note_beat(sample("arm3", "here"))
    now[0] += 0.5
    assert beats.silence("arm1") == 0.5
    now[0] += FORGET + 1
    beats._check(now[0])
    for name in ("arm0", "arm3"):
        assert beats.silence(name) == 0.0, "of this machine"


def test_an_agent_of_a_machine_that_is_heard_is_not_forgotten(beats, now) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += FORGET + 1
    beats._note_beat(sample("arm2", "m"))
    beats._check(now[0])
    assert beats.silence("arm1") == 0.0


def test_who_stays_away_is_forgotten(beats, now) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += FORGET + 1.0
    beats._check(now[0])
    assert not beats._agents
