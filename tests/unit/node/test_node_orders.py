"""An order to an RTPU is carried out once; a repetition waits until that is done."""

from __future__ import annotations

import asyncio
from collections import deque
from types import SimpleNamespace

import msgspec
import pytest

from pbonet.node.rtpu import signal_tasks
from pbonet.node.rtpu.request_handlers import RequestHandlers
from pbonet.node.wire.event_log import EventLog
from pbonet.xm.net import codec, messages as m

ORDERS = {
    "stop": m.Stop(subsystem="arm", stop_id="s1"),
    "replaced": m.Replaced(subsystem="arm", stop_id="s1", tasks={"arm0": ["t"]}),
}


@pytest.fixture
def rtpu():
    return SimpleNamespace(
        name="arm0",
        stops=deque(),
        events=EventLog("arm0"),
        claims=SimpleNamespace(stand=lambda *_: None),
        publish_claims=lambda: None,
        of=lambda _subsystem: [],
    )


@pytest.mark.parametrize("kind", ORDERS)
@pytest.mark.parametrize("fails", [False, True])
def test_a_repetition_is_answered_when_the_order_is_carried_out(
    rtpu, monkeypatch, kind, fails
):
    """The sender uses the machine after the answer: nothing may be ON there."""
    begun, started, go_on = [], asyncio.Event(), asyncio.Event()

    async def carry_out(*_):
        begun.append(kind)
        started.set()
        await go_on.wait()
        if fails and len(begun) == 1:
            raise RuntimeError("a fault")
        return m.Stopped(off=["t"], killed=[])

    async def run():
        handlers = RequestHandlers(rtpu)

        def ask(client):
            request = msgspec.structs.replace(ORDERS[kind], id="1", client=client)
            return asyncio.create_task(handlers.handle(codec.Codec().pack(request)))

        first = ask("master")
        await started.wait()
        second = ask("agent")
        for _ in range(50):
            await asyncio.sleep(0)
        early = second.done(), list(rtpu.stops)
        go_on.set()
        return early, [codec.Codec().answer(await one) for one in (first, second)]

    monkeypatch.setattr(signal_tasks, kind, carry_out)
    early, (first, second) = asyncio.run(run())
    assert early == (False, []), "it is not carried out yet, and nobody is told so"
    assert first.ok != fails
    assert second.ok
    assert len(begun) == 1 + fails
    assert second.result["off"] == ["t"] * fails
    assert list(rtpu.stops) == ["s1"]
