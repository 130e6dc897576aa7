"""Tasks that are created while other things happen to their subsystem."""

from __future__ import annotations

import asyncio
from collections import Counter
from unittest.mock import AsyncMock, Mock

import pytest
from nodekit import rmod

from pbonet.errors import StateError
from pbonet.node.rtpu import create_task
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
