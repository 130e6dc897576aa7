"""A signal for a task of another RTPU of the machine: who is asked, and who answers."""

from __future__ import annotations

import asyncio
import contextlib

import msgspec
import pytest

from pbonet.errors import WireError
from pbonet.node.wire import ask_neighbours, rtpu_messages
from pbonet.xm.net.run_folder import NameLock, Places

pytestmark = pytest.mark.usefixtures("run_dir")
ORDER = rtpu_messages.Order("arm", "grip", "off")
HAS_IT = rtpu_messages.Obeyed(here=True)
REFUSES = rtpu_messages.Obeyed(here=True, error=WireError(code="STATE", what="no"))
HAS_IT_NOT = rtpu_messages.Obeyed(here=False)


@contextlib.asynccontextmanager
async def neighbour(name, answer):
    """An RTPU process that answers so; None: it hangs. Yields what it was asked."""
    asked, ended = [], []

    async def serve(reader, writer):
        ended.append(asyncio.current_task())
        frame = await rtpu_messages.read_frame(reader)
        asked.append(msgspec.msgpack.decode(frame, type=rtpu_messages.ToRtpu))
        if answer is None:
            await reader.read()
        elif isinstance(answer, bytes):
            writer.write(answer)
        else:
            writer.write(rtpu_messages.frame(answer))
        writer.close()
        await writer.wait_closed()

    places = Places("d", name)
    lock = NameLock(places.ctl_lock, "a test")
    try:
        async with await asyncio.start_unix_server(serve, places.ctl):
            yield asked
            await asyncio.gather(*ended)
    finally:
        lock.release()
        places.remove(places.ctl, places.ctl_lock)


async def ask(answers, limit):
    async with contextlib.AsyncExitStack() as stack:
        asked = [
            await stack.enter_async_context(neighbour(*one)) for one in answers.items()
        ]
        found = await ask_neighbours(Places("d", "r0"), ORDER, limit)
    assert asked == [[ORDER]] * len(answers)
    return found


@pytest.mark.parametrize("answer", [HAS_IT, REFUSES])
def test_the_rtpu_that_has_the_task_answers_though_another_one_hangs(answer):
    others = {"r1": HAS_IT_NOT, "r2": None, "r3": answer}
    found = asyncio.run(ask(others, 600.0))
    assert found.answer == answer
    assert found.asked == ["r1", "r2", "r3"]


def test_those_that_give_no_answer_are_named():
    """One hangs, one sends nonsense, one ends, one does not listen, one has it not."""
    gone = NameLock(Places("d", "r5").ctl_lock, "it starts")
    others = {"r1": None, "r2": b"\0\0\0\1?", "r3": b"", "r4": HAS_IT_NOT}
    found = asyncio.run(ask(others, 0.3))
    gone.release()
    assert found.answer is None
    assert found.asked == ["r1", "r2", "r3", "r4", "r5"]
    assert found.silent == ["r1", "r2", "r3", "r5"]


def test_an_rtpu_without_neighbours_asks_nobody():
    found = asyncio.run(ask_neighbours(Places("d", "r0"), ORDER, 600.0))
    assert found == (None, [], [])
