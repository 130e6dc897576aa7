"""Heirs of tasks on other RTPUs of the machine: they stand by, and are called.

An heir one of whose predecessors has another dispatcher cannot wait for it in its own
core table. It waits for calls instead (``call.h``): each predecessor, as
its `off` has ended, calls in the heir's core table, and the dispatcher there engages
the heir in its next turn. No message is waited for in between, and no master.

A ticket, which no other wait has had, tells whose call it is. Who does not find it in
the table that he sees is on another machine, or too late.

Where they are known to be on another machine the agents call (`farcalls`), and the
``on`` of the master has the heir engaged at the latest.
"""

from __future__ import annotations

import asyncio
import secrets
from typing import TYPE_CHECKING, Protocol

from msgspec import Struct

from pbonet.analysis.schedule import Mode
from pbonet.errors import PbonetError
from pbonet.node.wire import rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import Call

from .fallbacks import Home, come, rest

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from .fallbacks import Fallbacks
    from .illegal_flag import Flags
    from .task_handle import Task


class HeirsHome(Home, Protocol):
    """What is needed beside that of the RTPU that the heirs are on."""

    fallbacks: Fallbacks
    flags: Flags

    def rank(self, *joining: Task) -> None:
        """Rank all tasks anew; those that join count already."""
        ...

    def later(self, chore: Coroutine[None, None, None], name: str) -> None:
        """Do something that no request waits for."""
        ...


class Waiting(Struct):
    """An heir that stands by, or has come on and was not asked for yet."""

    task: Task
    after: list[str]
    """Who calls it."""
    timer: asyncio.TimerHandle
    calls: list[Call] = []
    """Those of an heir that is called from another machine."""


class Heirs:
    """The heirs of one RTPU.

    Args:
        rtpu: Whose.
    """

    def __init__(self, rtpu: HeirsHome) -> None:
        self._rtpu = rtpu
        self._waiting: dict[tuple[str, str], Waiting] = {}

    async def expect(
        self,
        subsystem: str,
        after: dict[str, list[str]],
        limit: float,
        *,
        far: bool = False,
    ) -> dict[str, list[Call]]:
        """Have tasks stand by for others; an empty list ends that.

        Args:
            subsystem: Whose tasks.
            after: The heirs, and for each the tasks, on any RTPU, that it waits for.
            limit: Seconds after which they stand by no longer.
            far: Whether those they wait for are on another machine.

        Returns:
            For each task that is waited for whom it has to call.

        Raises:
            PbonetError: One could not take over: why. None of them stands by.
        """
        rtpu = self._rtpu
        tasks = {name: rtpu.need(subsystem, name) for name in after}
        calls: dict[str, list[Call]] = {}
        try:
            for name, task in tasks.items():
                await self.withdraw(task)
                if after[name]:
                    made = await self._stand_by(task, after[name], limit, far=far)
                    for old, call in zip(after[name], made, strict=True):
                        calls.setdefault(old, []).append(call)
        except BaseException:
            for task in tasks.values():
                await self.withdraw(task)
            raise
        return calls

    async def _stand_by(
        self, task: Task, after: list[str], limit: float, *, far: bool
    ) -> list[Call]:
        rtpu, slot = self._rtpu, task.facts.slot
        owners = self._owners(task) if far else []
        await rtpu.fallbacks.withdraw(task)
        rtpu.rank(task)
        task.engaged = asyncio.get_running_loop().create_future()
        ticket = secrets.randbelow(0xFFFFFFFF) + 1
        life = rtpu.core.expect(slot, ticket, len(after))
        try:
            await task.command(
                "prepare",
                lambda n: rtpu_messages.Prepare(n, after, owners, far=far),
                limit,
            )
            await rtpu.fallbacks.ready(task, [*after, *owners])
        except BaseException:
            rtpu.core.follow(slot, 0, [])
            raise
        key = task.facts.subsystem, task.name
        timer = asyncio.get_running_loop().call_later(limit, self._expire, key)
        calls = [
            Call(
                heir=task.name,
                outputs=task.facts.outputs,
                core=rtpu.core.core,
                slot=slot,
                life=life,
                ticket=ticket,
                caller=caller,
                far=far,
            )
            for caller in range(len(after))
        ]
        self._waiting[key] = Waiting(task, after, timer, calls if far else [])
        return calls

    def _owners(self, task: Task) -> list[str]:
        """Return who owns the variables of a task, as this machine's table names it."""
        return sorted(self._rtpu.flags.owners(task.facts.subsystem, task.facts.outputs))

    def waits(self, task: Task) -> bool:
        """Tell whether a task stands by, or came on and was not asked for yet.

        One of its name that has died meanwhile is another one.
        """
        waiting = self._waiting.get((task.facts.subsystem, task.name))
        return waiting is not None and waiting.task is task

    def callers(self, task: Task) -> list[str]:
        """Return the tasks that a task waits for, on any RTPU."""
        waiting = self._waiting.get((task.facts.subsystem, task.name))
        return waiting.after if waiting is not None and waiting.task is task else []

    async def asked(self, task: Task) -> bool:
        """Take note that the ``on`` of a task is asked for.

        Returns:
            Whether it comes by itself: it stands by, or came on already. One that waits
            for another machine is called from here, if nobody writes its variables any
            more; else it stands by no longer.
        """
        waiting = self._waiting.get((task.facts.subsystem, task.name))
        if waiting is None or waiting.task is not task:
            return False
        if waiting.calls and task.engaged and not task.engaged.done():
            if self._owners(task):
                await self.withdraw(task)
                return task.engaged.done()
            for call in waiting.calls:
                core = self._rtpu.core
                core.call(call.slot, call.life, call.ticket, call.caller)
        return True

    async def come(self, task: Task, limit: float) -> None:
        """Wait until an heir has come on.

        Raises:
            PbonetError: Its `on` failed, or nobody called it in time.
        """
        self._forget(task)
        try:
            await come(task, limit)
        except PbonetError:
            await self._rtpu.fallbacks.spare(task)
            if task.state is State.OFF:
                await rest(self._rtpu, task)
            raise

    async def withdraw(self, task: Task) -> None:
        """Have a task stand by no longer, if it does."""
        if self._forget(task) and task.engaged and not task.engaged.done():
            await rest(self._rtpu, task)

    def died(self, task: Task, *, called: bool = False, ended: bool = False) -> None:
        """Keep the flag up for a task that has died as it was about to come on.

        Its death has raised it natively. While somebody writes what it was to take over
        the entry stands until the exchange of the two has ended.

        Args:
            task: The task.
            called: Those before it call it, and one of them has ended. The exchange is
                not this RTPU's alone: the entry stands until all is written anew.
            ended: Their exchange has; who writes now goes on.
        """
        rtpu, subsystem, outputs = self._rtpu, task.facts.subsystem, task.facts.outputs
        owners = rtpu.flags.owners(subsystem, outputs)
        slots = [
            rtpu.core.snapshot(one.facts.slot)
            for one in rtpu.of(subsystem)
            if one.name in owners and one is not task
        ]
        there = any(s.mode in {Mode.ON, Mode.COMMAND} and not s.dead for s in slots)
        written = there and not called
        if written and ended:
            rtpu.flags.down(subsystem, task.name)
            return
        if not written:
            rtpu.flags.ceded(subsystem, outputs)
        cause = f"{task.name} has died"
        rtpu.flags.up(subsystem, task.name, cause, () if written else outputs)

    def dismiss_all(self, subsystem: str) -> None:
        """Have nobody engaged any more: the subsystem is being stopped."""
        for task in self._rtpu.of(subsystem):
            self.dismiss(task)

    def dismiss(self, task: Task) -> None:
        """Have a task not engaged any more, without a word to it: it is being ended."""
        if self._forget(task):
            self._rtpu.core.follow(task.facts.slot, 0, [])

    def _forget(self, task: Task) -> bool:
        waiting = self._waiting.pop((task.facts.subsystem, task.name), None)
        if waiting is not None:
            waiting.timer.cancel()
        return waiting is not None and waiting.task is task

    def _expire(self, key: tuple[str, str]) -> None:
        """Whoever wanted the exchange has not gone on with it."""
        waiting = self._waiting.get(key)
        if waiting is not None:
            withdrawn = self.withdraw(waiting.task)
            self._rtpu.later(withdrawn, f"{key[1]} stands by no longer")
