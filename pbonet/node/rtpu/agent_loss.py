"""Handles the variables of remote tasks when the agent that carried them is gone.

Variables that tasks on other machines write were owned here by the agent. They are no
longer updated, so they are given up for a task here to take over, and the
illegal-configuration flag is up until they are written again. Another agent of this
machine carries them on if there is one, and a restarted agent does.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from pbonet.errors import SvarError, SvarOwnerError
from pbonet.svar.mirror import MARK

if TYPE_CHECKING:
    from .rtpu_state import Rtpu

NAME = "agent"
"""The subject of the entry in the flag."""
PATIENCE = 1.0
"""Seconds in which a process whose socket was closed has ended, if it was killed."""
PAUSE = 0.005


async def give_up(rtpu: Rtpu) -> None:
    """Give up what a lost agent has carried, as soon as its process has ended."""
    end = time.monotonic() + PATIENCE
    while not _all_reaped(rtpu):
        if time.monotonic() > end:
            return  # it lives: it was asked to leave, or is another one
        await asyncio.sleep(PAUSE)


def back(rtpu: Rtpu) -> None:
    """Withdraw what was raised for the loss."""
    for subsystem in rtpu.tables.subsystems():
        rtpu.flags.down(subsystem, NAME)


def _all_reaped(rtpu: Rtpu) -> bool:
    """Free what dead processes held, in every table; False while one lives."""
    done = [_reaped(rtpu, subsystem) for subsystem in rtpu.tables.subsystems()]
    return all(done)


def _reaped(rtpu: Rtpu, subsystem: str) -> bool:
    """Free what dead processes held for other machines; False while one lives."""
    opened = rtpu.tables.get(subsystem)
    if opened is None:
        return True
    lost: list[str] = []
    try:
        for register in opened.table.registers():
            if MARK in register.task and register.held:
                lost += opened.table.reap(register.owner)
    except SvarOwnerError:
        return False
    except SvarError:
        return True
    finally:
        if lost:
            cause = f"no agent transfers {' '.join(lost)} from other machines"
            rtpu.flags.up(subsystem, NAME, cause[:120], lost)
    return True
