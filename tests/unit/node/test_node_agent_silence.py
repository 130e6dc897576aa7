"""The flag that an RTPU process raises when its agent gives no sign of life."""

from __future__ import annotations

import asyncio
import socket
import time
from types import SimpleNamespace

import pytest

from pbonet.node.agent import Agent
from pbonet.node.rtpu.agent_loss import SILENCE, Silence
from pbonet.node.wire.rtpu_messages import OpenTable


class Flags:
    def __init__(self):
        self.raised = {}

    def up(self, subsystem, name, cause):
        self.raised[subsystem, name] = cause

    def down(self, subsystem, name):
        self.raised.pop((subsystem, name))


def test_the_flag_is_up_while_the_agent_is_silent(monkeypatch):
    clock, flags = [100.0], Flags()
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    times = {"arm": 1.0, "leg": 3.0, "never": 0.0}
    tables = {
        name: SimpleNamespace(use=SimpleNamespace(alone=alone))
        for name, alone in times.items()
    }
    rtpu = SimpleNamespace(flags=flags, tables=tables)

    async def run():
        silence = Silence(rtpu)
        silence.take(dict.fromkeys([*times, "closed"], 0.0))

        def after(seconds):
            clock[0] += seconds
            silence._check()
            return {subsystem for subsystem, _ in flags.raised}

        assert after(0.9) == set()
        assert after(0.2) == {"arm"}
        cause = "the agent gives no sign of life for 1 s (ALONE)"
        assert flags.raised["arm", SILENCE] == cause
        assert after(2.0) == {"arm", "leg"}
        silence.take({"arm": 1.1, "leg": 3.1})
        assert len(flags.raised) == 2, "the keeper has not answered yet"
        silence.take({"leg": 0.2})
        assert not flags.raised
        assert after(2.0) == set(), "the keeper of the other one is here now"
        silence.take({"leg": 2.8, "arm": 0.0})
        assert after(0.4) == set(), "the agent may come within that time"
        assert after(0.2) == {"leg"}, "the keeper had been silent before"
        silence.take({})
        assert after(9.0) == set()
        assert silence._timer is None
        silence.take({"arm": 0.0})
        assert after(1.1) == {"arm"}
        silence.close()

    asyncio.run(run())


def test_only_a_keeper_elsewhere_that_is_named_is_expected_to_answer():
    sent = []
    tables = {
        "arm": OpenTable(keep=True, keeper="", alone=2.0),
        "leg": OpenTable(keep=True, keeper="here", alone=2.0),
        "head": OpenTable(keep=False, keeper="far", alone=2.0),
        "free": OpenTable(keep=False, keeper="far", alone=0.0),
    }
    agent = Agent.__new__(Agent)
    agent._apart, agent._note = {}, sent.append
    agent._link = SimpleNamespace(info=SimpleNamespace(tables=tables))
    agent._heartbeat = SimpleNamespace(
        silence=lambda *_: 0.5, is_here=lambda name: name == "here"
    )
    agent._send_alive()
    assert [one.silences for one in sent] == [{"head": 0.5}]


def test_one_timer_waits_for_the_silence_and_each_sign_of_life_moves_it(monkeypatch):
    """So nothing wakes between signs of life, and the flag is not up late."""
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    tables = {"arm": SimpleNamespace(use=SimpleNamespace(alone=1.0))}

    async def run():
        silence = Silence(SimpleNamespace(flags=Flags(), tables=tables))
        for now, before, at in (
            (100.0, 0.0, 101.0),
            (100.2, 0.0, 101.2),
            (100.4, 0.3, 101.1),
            (100.6, 9.0, 101.1),
        ):
            clock[0] = now
            silence.take({"arm": before})
            assert silence._timer.when() == pytest.approx(at)
        silence.take({})
        assert silence._timer is None

    asyncio.run(run())


def test_a_sign_of_life_that_waits_to_be_read_counts_first(monkeypatch):
    """As when this process was stopped for longer than ALONE, and the agent was not."""
    clock, flags = [100.0], Flags()
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    tables = {"arm": SimpleNamespace(use=SimpleNamespace(alone=1.0))}

    async def run():
        silence = Silence(SimpleNamespace(flags=flags, tables=tables))
        here, there = socket.socketpair()
        reader, writer = await asyncio.open_connection(sock=here)

        async def serve():
            silence.take({"arm": 0.0})
            await reader.readexactly(1)
            assert not flags.raised
            silence.take({"arm": 0.0})

        served = asyncio.ensure_future(serve())
        await asyncio.sleep(0)
        clock[0] += 5.0
        with there:
            there.sendall(b"x")
            await served
            assert not flags.raised
        writer.close()
        await writer.wait_closed()

    asyncio.run(run())
