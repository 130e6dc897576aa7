"""Tasks that are created while other things happen to their subsystem."""

from __future__ import annotations

import asyncio
from collections import Counter
from unittest.mock import AsyncMock, Mock

import pytest
from nodekit import rmod

from pbonet.errors import NodeError, StateError
from pbonet.node.rtpu import create_task
from pbonet.node.wire.rtpu_messages import RtpuConfig
from pbonet.xm.net import Spawn


def test_a_task_that_was_forked_during_a_stop_does_not_stay(monkeypatch) -> None:
    task, rtpu = Mock(end=AsyncMock()), Mock(tasks={}, times_stopped=Counter())
    rtpu.name = "arm0"

    async def fork(*_):
        rtpu.times_stopped["arm"] += 1
        return task

    monkeypatch.setattr(create_task, "_fork", fork)
    spawn = Spawn(subsystem="arm", task="a", rmod=rmod("counts"), rmod_name="a")
    with pytest.raises(StateError, match="arm was stopped while a was being created"):
        asyncio.run(create_task.spawn(rtpu, spawn))
    task.end.assert_awaited_once_with(0.0)
    task.wait_for.assert_not_called()


@pytest.mark.parametrize(
    ("error", "left"),
    [
        (asyncio.CancelledError, {"d.arm.a"}),  # the end of the process removes it
        (NodeError("the process cannot be forked"), set()),
    ],
)
def test_the_ring_of_a_task_is_on_record_before_its_process_is_there(error, left):
    """Its RTPU process may be killed, or end, before it learns of the task.

    If there is no task, the next ring of that name may be another RTPU's.
    """
    rtpu = Mock(tasks={}, times_stopped=Counter(), rings=set())
    rtpu.name = "arm0"
    rtpu.config = RtpuConfig(name="arm0", domain="d", core=0)
    rtpu.claims.get.return_value = None
    saved = []
    rtpu.save.side_effect = lambda: saved.append(set(rtpu.rings))

    async def fork(*_):
        assert saved == [{"d.arm.a"}]
        raise error

    rtpu.spawner.fork = fork
    spawn = Spawn(subsystem="arm", task="a", rmod=rmod("counts"), rmod_name="a")
    with pytest.raises((asyncio.CancelledError, NodeError)):
        asyncio.run(create_task.spawn(rtpu, spawn))
    assert rtpu.rings == saved[-1] == left
