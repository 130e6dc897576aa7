"""Asks the other RTPUs of the machine to carry out a signal of a module.

It goes from RTPU process to RTPU process, on the socket where the other one accepts its
agent. No agent, no master and no network takes part.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from pbonet.errors import NodeError
from pbonet.xm.net import run_folder

from . import rtpu_messages

if TYPE_CHECKING:
    from pathlib import Path


class Neighbours(NamedTuple):
    """The outcome of asking the other RTPUs of the machine."""

    answer: rtpu_messages.Obeyed | None
    """That of the RTPU which has the task; None: none that answered has it."""
    asked: list[str]
    silent: list[str]
    """RTPUs that gave no answer."""


async def ask_neighbours(
    places: run_folder.Places, order: rtpu_messages.Order, limit: float
) -> Neighbours:
    """Have the RTPU of this machine that has a task carry out a signal for it.

    All are asked at once, so that one which hangs delays no other.

    Args:
        places: The files of the RTPU that asks.
        order: The signal.
        limit: Seconds for an answer.
    """
    names = [name for name in places.neighbours() if name != places.name]
    asking = {
        asyncio.create_task(_ask(run_folder.Places(places.domain, name).ctl, order)): (
            name
        )
        for name in names
    }
    silent = {*names}
    waiting = set(asking)
    try:
        async with asyncio.timeout(limit):
            while waiting:
                done, waiting = await asyncio.wait(
                    waiting, return_when=asyncio.FIRST_COMPLETED
                )
                for one in done:
                    answer = one.result()
                    if answer is not None:
                        silent.discard(asking[one])
                    if answer is not None and answer.here:
                        return Neighbours(answer, names, sorted(silent))
    except TimeoutError:
        pass
    finally:
        for one in waiting:
            one.cancel()
    return Neighbours(None, names, sorted(silent))


async def _ask(path: Path, order: rtpu_messages.Order) -> rtpu_messages.Obeyed | None:
    """Return the answer of one RTPU process; None: it gives none."""
    try:
        reader, writer = await asyncio.open_unix_connection(path)
    except OSError:
        return None
    try:
        writer.write(rtpu_messages.frame(order))
        data = await rtpu_messages.read_frame(reader)
        return msgspec.msgpack.decode(data, type=rtpu_messages.Obeyed)
    except (OSError, asyncio.IncompleteReadError, NodeError, msgspec.MsgspecError):
        return None
    finally:
        writer.close()
