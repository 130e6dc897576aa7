"""Handles the variables of remote tasks when the agent that carried them is gone.

Variables that tasks on other machines write were owned here by the agent. They are no
longer updated, so they are given up for a task here to take over, and the
illegal-configuration flag is up until they are written again. Another agent of this
machine carries them on if there is one, and a restarted agent does.

An agent that hangs, is stopped or was killed cannot notice that the keeper's machine is
out of sight (``ALONE``), and others may take its machine for lost. So the RTPU process
expects signs of life from it, and raises the flag itself.
"""

from __future__ import annotations

import asyncio
import math
import time
from typing import TYPE_CHECKING

from pbonet.errors import SvarError, SvarOwnerError
from pbonet.node.wire import core_trace
from pbonet.svar.mirror import MARK

if TYPE_CHECKING:
    from .rtpu_state import Rtpu

NAME = "agent"
"""The subject of the entry in the flag."""
PATIENCE = 1.0
"""Seconds in which a process whose socket was closed has ended, if it was killed."""
PAUSE = 0.005
SILENCE = "agent's silence"
"""The subject of the entry for an agent that gives no sign of life."""
MISSED = 0.5
"""Seconds after which the agent, if it works, has given another one. Then the time for
which the keeper had not answered before counts, too."""


class Silence:
    """The signs of life that the RTPU process expects from its agent.

    Args:
        rtpu: The RTPU.
    """

    def __init__(self, rtpu: Rtpu) -> None:
        self._rtpu = rtpu
        self._silences: dict[str, float] = {}
        self._last = 0.0
        self._raised: set[str] = set()
        self._timer: asyncio.Handle | None = None

    def take(self, silences: dict[str, float]) -> None:
        """Take a sign of life; more are expected while subsystems are named.

        An agent that works again may have missed the loss of the keeper's machine. So
        the flag stays up until that has answered.

        Args:
            silences: Subsystems, and for how long their keeper's machine has not
                answered.
        """
        self._last, self._silences = time.monotonic(), silences
        for subsystem in list(self._raised):
            if silences.get(subsystem, 0.0) <= self._alone(subsystem):
                self._raised.discard(subsystem)
                self._rtpu.flags.down(subsystem, SILENCE)
        self._check()

    def close(self) -> None:
        """Expect no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _check(self) -> None:
        """Raise the flag for the subsystems whose time is over; come again for others.

        Signs of life come more often than that, so nothing wakes for it between them.
        """
        self.close()
        silent, left = time.monotonic() - self._last, math.inf
        for subsystem, before in self._silences.items():
            alone = self._alone(subsystem)
            if not alone or subsystem in self._raised:
                continue
            limit = min(alone, max(MISSED, alone - before))
            if silent < limit:
                left = min(left, limit - silent)
                continue
            self._raised.add(subsystem)
            cause = f"the agent gives no sign of life for {alone:g} s (ALONE)"
            self._rtpu.flags.up(subsystem, SILENCE, cause)
        if left < math.inf:
            again = asyncio.get_running_loop().call_later
            self._timer = again(left, self._expire)

    def _expire(self) -> None:
        """Check, after the signs of life that wait to be read.

        They do so when this process itself was stopped.
        """
        self._timer = asyncio.get_running_loop().call_soon(self._check)

    def _alone(self, subsystem: str) -> float:
        """Return the time of ``ALONE``; 0: never."""
        opened = self._rtpu.tables.get(subsystem)
        return opened.use.alone if opened is not None else 0.0


async def give_up(rtpu: Rtpu) -> None:
    """Give up what a lost agent has carried, as soon as its process has ended."""
    end = time.monotonic() + PATIENCE
    while not _all_reaped(rtpu):
        if time.monotonic() > end:
            return  # it lives: it was asked to leave, or is another one
        await asyncio.sleep(PAUSE)


async def forget_trace() -> None:
    """Have the kernel follow no core any more for an agent that was killed.

    Its socket is closed before its files in tracefs are.
    """
    await asyncio.sleep(PATIENCE)
    await asyncio.to_thread(core_trace.sweep)


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
