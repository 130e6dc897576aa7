"""A master starts agents of its own only if each endpoint that was named answers."""

from __future__ import annotations

import socket
import threading

import pytest

from pbonet.errors import UnreachableError
from pbonet.master.subsystem import embedded_agents
from pbonet.master.subsystem.subsystem import Subsystem

BOTH = ["arm0", "arm1"]


@pytest.fixture
def wrong():
    """An endpoint whose port is held, and where nothing listens."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        yield f"tcp/127.0.0.1:{held.getsockname()[1]}"


@pytest.fixture
def started(monkeypatch):
    """The RTPUs whose agents the master starts; there is no process to be had."""
    rtpus = []

    def launch(_, rtpu, _core):
        rtpus.append(rtpu)
        raise OSError("no process")

    monkeypatch.setattr(embedded_agents.Embedded, "_launch", launch)
    return rtpus


def opened(world, puma, *connect):
    return Subsystem(puma, domain=world.domain, connect=connect, embed=True).open()


def test_a_program_refuses_to_start_agents_while_its_endpoint_is_not_reached(
    world, puma, wrong, started
):
    with pytest.raises(UnreachableError) as refused:
        opened(world, puma, wrong)
    assert str(refused.value).startswith(
        f"{wrong}: this endpoint was named and is not reached; nothing was started "
        "(expected its answer, before arm0 and arm1 may be started on this machine, "
        "got from 127.0.0.1: Connection refused); check the address, start the agents "
        "there, or leave --connect, PBONET_CONNECT and connect= out to run here; "
    )
    assert not started


def test_run_refuses_it_too(call, world, puma, wrong, started):
    words = ["run", puma.with_suffix(".job"), "--domain", world.domain]
    status, out, err = call(*words, "--connect", wrong)
    assert (status, out) == (1, "")
    assert f"pbonet: {wrong}: this endpoint was named and is not reached" in err
    assert not started


def test_an_endpoint_of_the_environment_counts(
    world, puma, wrong, started, monkeypatch
):
    monkeypatch.setenv("PBONET_CONNECT", wrong)
    with pytest.raises(UnreachableError, match="before arm0 and arm1 may be started"):
        Subsystem(puma, domain=world.domain, embed=True).open()
    assert not started


def test_an_agent_of_this_machine_does_not_stand_for_the_endpoint(
    world, agents, puma, wrong, started
):
    agents("arm0")
    with pytest.raises(UnreachableError, match="before arm1 may be started"):
        opened(world, puma, wrong)
    assert not started


def test_each_endpoint_must_answer(world, agents, puma, wrong, started):
    """The RTPU that is missing may be the one at the other endpoint."""
    there = agents("arm0")["arm0"].places.endpoint
    with pytest.raises(UnreachableError) as refused:
        opened(world, puma, there, wrong)
    assert refused.value.where == wrong
    assert not started


def test_no_endpoint_is_asked_for_where_no_agent_is_missing(
    world, agents, puma, wrong, started
):
    agents(*BOTH)
    opened(world, puma, wrong).detach()
    assert not started


def test_what_is_missing_is_started_where_the_endpoint_answers(
    world, agents, puma, started
):
    there = agents("arm0")["arm0"].places.endpoint
    with pytest.raises(OSError, match="no process"):
        opened(world, puma, there)
    assert started == ["arm1"]


def test_agents_that_come_later_are_waited_for(world, agents, wrong):
    """The endpoint is not reached at first, which ends no waiting."""
    told = []

    def tell(text):
        told.append(text)
        agents(*BOTH)

    embedded = embedded_agents.Embedded(world.domain, connect=[wrong])
    embedded.await_others(BOTH, 300.0, threading.Event(), tell)
    assert told == ["waiting for arm0 and arm1, at most 300 s"]
