"""Successors: tasks that stand by until all their predecessors have called.

A task that takes over stands by with a ticket in its slot (``call.h``). Each of its
predecessors calls when its `off` has ended, and the dispatcher engages the successor in
its next turn. No message is waited for in between, and no master. It is the same
whether they are on one core, on two cores of a machine, or on two machines: there the
agent calls with the news of the table, and the ``on`` of the master does
so at the latest.

A ticket, which is unique to one wait, identifies the call. A caller that does not find
it in the slot is too late.
"""

from __future__ import annotations

import asyncio
import secrets
from typing import TYPE_CHECKING, Protocol

from pbonet.errors import NoAnswerError
from pbonet.node.wire import rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import LAST_TICKET, Call

from .task_handle import Waiting, error_of, rest

if TYPE_CHECKING:
    from collections.abc import Collection, Coroutine

    from pbonet.node import rt

    from .fallbacks import Fallbacks
    from .illegal_flag import Flags
    from .task_handle import Task


class Home(Protocol):
    """The part of an RTPU that successors need."""

    core: rt.CoreTable
    flags: Flags

    @property
    def fallbacks(self) -> Fallbacks:
        """The tasks that stand by for a failure."""
        ...

    def of(self, subsystem: str) -> list[Task]:
        """Return the tasks of a subsystem."""
        ...

    def need(self, subsystem: str, name: str) -> Task:
        """Return a task, or raise UnknownTaskError."""
        ...

    def rank(self, *joining: Task) -> None:
        """Rank all tasks again; those that join count already."""
        ...

    def later(self, chore: Coroutine[None, None, None], name: str) -> None:
        """Do something that no request waits for."""
        ...


class Successors:
    """The successors of one RTPU.

    Args:
        rtpu: The RTPU they are on.
    """

    def __init__(self, rtpu: Home) -> None:
        self._rtpu = rtpu

    async def expect(
        self,
        subsystem: str,
        after: dict[str, list[str]],
        limit: float,
        *,
        far: Collection[str] = (),
    ) -> dict[str, list[Call]]:
        """Let tasks stand by for others; an empty list ends that.

        Args:
            subsystem: The subsystem of the tasks.
            after: The successors, and of each its predecessors, on any RTPU.
            limit: Seconds after which they stand by no longer.
            far: Those of the predecessors that are on other machines.

        Returns:
            For each predecessor the calls that it has to make.

        Raises:
            PbonetError: One could not take over: why. None of them stands by.
        """
        tasks = {name: self._rtpu.need(subsystem, name) for name in after}
        calls: dict[str, list[Call]] = {}
        self._rtpu.rank(*(task for name, task in tasks.items() if after[name]))
        try:
            for name, task in tasks.items():
                await self.withdraw(task)
                if after[name]:
                    made = await self.stand_by(task, after[name], limit, far=far)
                    for old, call in zip(after[name], made, strict=True):
                        calls.setdefault(old, []).append(call)
        except BaseException:
            for task in tasks.values():
                await self.withdraw(task)
            raise
        return calls

    async def stand_by(
        self, task: Task, after: list[str], limit: float, *, far: Collection[str] = ()
    ) -> list[Call]:
        """Let a task stand by; return how each of its predecessors calls it.

        Args:
            task: It is OFF, and counts already among the ranked ones.
            after: Its predecessors.
            limit: Seconds that getting ready may take, and standing by.
            far: Those of them that are on other machines.

        Raises:
            PbonetError: It could not take over: why.
        """
        rtpu, slot = self._rtpu, task.facts.slot
        await self.withdraw(task)
        away = [one for one in after if one in far]
        owners = sorted(self._owners(task)) if away else []
        await rtpu.fallbacks.withdraw(task)
        task.engaged = asyncio.get_running_loop().create_future()
        ticket = secrets.randbelow(LAST_TICKET) + 1
        life = rtpu.core.expect(slot, ticket, len(after))
        try:
            await task.command(
                "prepare",
                lambda n: rtpu_messages.Prepare(n, after, owners, far=away),
                limit,
            )
            await rtpu.fallbacks.ready(task, [*after, *owners])
        except BaseException:
            rtpu.core.follow(slot, [])
            raise
        calls = [
            Call(
                successor=task.name,
                outputs=task.facts.outputs,
                core=rtpu.core.core,
                slot=slot,
                life=life,
                ticket=ticket,
                caller=caller,
                far=old in far,
            )
            for caller, old in enumerate(after)
        ]
        timer = asyncio.get_running_loop().call_later(limit, self._expire, task)
        task.waiting = Waiting(after, calls, timer)
        return calls

    def _owners(self, task: Task) -> set[str]:
        """Return who owns the variables of a task, as this machine's table names it."""
        return self._rtpu.flags.owners(task.facts.subsystem, task.facts.outputs)

    async def asked(self, task: Task) -> bool:
        """Note that the ``on`` of a task is requested.

        Returns:
            Whether it comes by itself: it stands by, or came on already. For those of
            its predecessors that are on other machines it is called from here, if they
            write none of its variables any more; else it stands by no longer.
        """
        waiting = task.waiting
        if waiting is None:
            return False
        pairs = list(zip(waiting.after, waiting.calls, strict=True))
        far = [call for _, call in pairs if call.far]
        if far and task.engaged and not task.engaged.done():
            if self._owners(task).difference(
                old for old, call in pairs if not call.far
            ):
                await self.withdraw(task)
                return task.engaged.done()
            for call in far:
                core = self._rtpu.core
                core.call(call.slot, call.life, call.ticket, call.caller)
        return True

    async def come(self, task: Task, limit: float) -> None:
        """Wait until a successor has come on; see `give_up` if it does not.

        Raises:
            NoAnswerError: It was not engaged in time.
            PbonetError: Its `on` failed.
        """
        self._forget(task)
        if task.engaged is None:
            return
        try:
            async with asyncio.timeout(limit):
                notice = await asyncio.shield(task.engaged)
        except TimeoutError:
            raise NoAnswerError(
                "the task was not turned on in time",
                where=task.name,
                remedy="check its state and the load of its RTPU",
            ) from None
        if notice.error is not None:
            raise error_of(notice)

    async def give_up(self, task: Task) -> None:
        """End the standby of a task that did not come on, and of its fallback."""
        self._forget(task)
        await self._rtpu.fallbacks.spare(task)
        if task.state is State.OFF:
            await rest(self._rtpu.core, task)

    async def withdraw(self, task: Task) -> None:
        """End the standby of a task, if it stands by."""
        if self._forget(task) and task.engaged and not task.engaged.done():
            await rest(self._rtpu.core, task)

    def dismiss_all(self, subsystem: str) -> None:
        """Engage no task any more, because the subsystem is being stopped."""
        for task in self._rtpu.of(subsystem):
            self.dismiss(task)

    def dismiss(self, task: Task) -> None:
        """Keep a task from being engaged, without a message: it is being ended."""
        if self._forget(task):
            self._rtpu.core.follow(task.facts.slot, [])

    def _forget(self, task: Task) -> bool:
        """Forget what a task waits for; return whether it waited."""
        waiting, task.waiting = task.waiting, None
        if waiting is not None:
            waiting.timer.cancel()
        return waiting is not None

    def _expire(self, task: Task) -> None:
        """End a wait that the master has not followed up."""
        if task.waiting is not None:
            withdrawn = self.withdraw(task)
            self._rtpu.later(withdrawn, f"{task.name} stands by no longer")
