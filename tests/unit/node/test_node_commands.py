"""A command that waits for a task: how long it was given is what its error says."""

import asyncio
import os
import socket
from types import SimpleNamespace

import pytest

from pbonet.errors import NoAnswerError
from pbonet.node.rtpu.task_handle import Task
from pbonet.node.wire import CoreWait


async def late(given):
    """Return the error of a command that waited for an earlier one first."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    read, write = os.pipe()
    os.set_blocking(read, False)
    near.setblocking(False)
    child = SimpleNamespace(
        sock=near,
        out=read,
        pid=0,
        send_signal=lambda _: None,
        core_wait=lambda: CoreWait(0),
    )
    facts = SimpleNamespace(name="servo", rmod=SimpleNamespace(freq=1.0))
    task = Task(
        *(facts, child),
        wake=lambda _: None,
        tell=lambda *_: None,
        changed=lambda: None,
        ended=lambda *_: None,
    )
    task._busy.clear()

    async def turn(_):
        return 0.0012

    task._turn = turn
    await task._lock.acquire()
    try:
        with pytest.raises(NoAnswerError) as caught:
            await task.command("off", lambda n: SimpleNamespace(n=n), given)
        return caught.value
    finally:
        task._life.cancel()
        await asyncio.gather(task._life, return_exceptions=True)
        asyncio.get_running_loop().remove_reader(read)
        far.close()
        near.close()
        os.close(read)
        os.close(write)


def test_the_limit_that_was_given_is_told_not_what_was_left_of_it(monkeypatch):
    monkeypatch.setattr("pbonet.node.wire.rtpu_messages.encode", lambda _: b"off")
    error = asyncio.run(late(2.0))
    assert error.what == "the task did not finish 'off' within 2 s"
