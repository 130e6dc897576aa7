"""Exchanges tasks at the dispatcher: the new ones are released as the old ones end.

Everything that can be done beforehand is: the new task stands by, OFF, and has been
found able to take over (Stewart 1994, section 3.10). Then the next cycle of the old one
is ordered to be its last. After that, still at the level of its cycles, its `off` runs
and it calls its successors (`successors`). The dispatcher grants each of them its `on`,
which takes the variables over as one event; its first cycle is released on the next
point of the grid. From the order on no message is waited for, neither of the network
nor between processes.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.analysis.schedule import Mode
from pbonet.config import TaskType
from pbonet.errors import PbonetError
from pbonet.node.wire import lifecycle, rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import MOST_CALLERS, Call

from .task_handle import rest

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

    from .rtpu_state import Rtpu
    from .task_handle import Task

    Step = Callable[[Task], Awaitable[None]]

Item = tuple[str, str]
TRIP = 0.05
"""Seconds in which what is on its way to another RTPU should have come."""
_LOOK = 0.001


def plan(
    rtpu: Rtpu,
    subsystem: str,
    items: Sequence[Item],
    calls: Mapping[str, list[Call]],
) -> dict[str, list[str]]:
    """Return which items at the beginning are carried out together; none: empty.

    Items belong together when they stand side by side and each is one of these: an
    ``off`` of a task that is ON and whose variables a later one of them takes over, or
    a task that stands by elsewhere; or the ``on`` of a task that takes variables over
    from earlier ones, which are given for it.

    Args:
        rtpu: Where the tasks are.
        subsystem: The subsystem of the tasks.
        items: What is left of a list.
        calls: For tasks that leave, the successors that stand by already.
    """
    found: dict[str, list[str]] = {}
    closed: dict[str, list[str]] = {}
    alone: set[str] = set()
    for name, signal in items:
        task = rtpu.tasks.get((subsystem, name))
        if task is None or name in found or not _is_exchanged(task, signal):
            break
        found[name] = []
        if signal == "off":
            alone |= {name} - calls.keys()
        else:
            mine = set(task.facts.outputs)
            olds = [rtpu.need(subsystem, one) for one in found if one != name]
            found[name] = [
                one.name
                for one in olds
                if one.state is State.ON and mine & set(one.facts.outputs)
            ]
            if not 0 < len(found[name]) <= MOST_CALLERS:
                break
            alone -= set(found[name])
        if not alone:
            closed = dict(found)
    return closed


def _is_exchanged(task: Task, signal: str) -> bool:
    """Return whether an item may be part of an exchange."""
    wanted = {"off": State.ON, "on": State.OFF}.get(signal)
    return (
        task.state is wanted
        and bool(task.facts.outputs)
        and not task.busy
        and (signal == "off" or task.waiting is None)
    )


def shortest_period(tasks: Iterable[Task]) -> float:
    """Return the period of the fastest of the tasks that are ON, in seconds."""
    rates = [task.freq for task in tasks if task.state is State.ON and task.freq]
    return 1.0 / max(rates, default=1.0)


def longest_period(tasks: Iterable[Task]) -> float:
    """Return the period of the slowest of the tasks that have one, in seconds."""
    return 1.0 / min((t.freq for t in tasks if t.freq), default=1.0)


class Exchange:
    """One exchange under way.

    Args:
        rtpu: Where all tasks are.
        subsystem: The subsystem of the tasks.
        after: The tasks in their order, with the predecessors of each that comes on;
            see `plan`.
        limit: Seconds that it may take.
        calls: For tasks that leave, the successors that stand by already.
        slowest: Seconds in which tasks of other RTPUs leave for the same successors.
    """

    def __init__(
        self,
        rtpu: Rtpu,
        subsystem: str,
        after: Mapping[str, list[str]],
        limit: float,
        calls: Mapping[str, list[Call]] | None = None,
        *,
        slowest: float = 0.0,
    ) -> None:
        self._rtpu = rtpu
        self._items = [(name, "on" if olds else "off") for name, olds in after.items()]
        self._deadline = time.monotonic() + limit
        self._after = after
        tasks = {name: rtpu.need(subsystem, name) for name in after}
        self._news = [tasks[name] for name, olds in after.items() if olds]
        self._olds = [tasks[name] for name, olds in after.items() if not olds]
        self._calls = {
            task.name: [*(calls or {}).get(task.name, ())] for task in self._olds
        }
        self._slowest = slowest
        self._came: set[str] = set()
        """Tasks that have come on; one may have failed in a cycle since."""
        self._ended: set[str] = set()
        """Tasks that have ended in order; one may have been engaged since."""
        self._unheard: set[str] = set()
        """Tasks that have ended and whose successors have died."""
        self.failed: dict[str, PbonetError] = {}
        """Errors, by task."""

    @property
    def undone(self) -> list[Item]:
        """Items that were not carried out: those that failed first."""
        done = {task.name for task in self._olds if task.state is State.OFF}
        done |= self._ended | self._came
        left = [item for item in self._items if item[0] not in done]
        return sorted(left, key=lambda item: item[0] not in self.failed)

    @property
    def _left(self) -> float:
        return max(self._deadline - time.monotonic(), 0.01)

    async def run(self, slow: Callable[[], None]) -> None:
        """Carry it out; `failed` then holds what went wrong.

        Args:
            slow: Called when it takes longer than a cycle of the slowest task that
                leaves, and one more.
        """
        self._rtpu.rank(*self._news)
        await self._each(self._news, self._prepare)
        if not self.failed:
            await self._each(self._olds, self._learn)
        if not self.failed:
            timer = self._watched(slow)
            try:
                await self._each(self._olds, self._end)
                self._call_far()
                await self._each(self._news, self._come)
                await self._taken()
            finally:
                timer.cancel()
        self._abandon()
        # First, for a task that was engaged nevertheless finds its variables free then.
        await self._each([t for t in self._olds if self._has_rest(t)], self._disown)
        for task in self._news:
            if not self._has_come(task):
                await self._rtpu.successors.give_up(task)

    def _watched(self, slow: Callable[[], None]) -> asyncio.TimerHandle:
        """Call `slow` unless all new tasks are armed by then."""
        core, tasks = self._rtpu.core, (*self._news, *self._olds)

        def report_late() -> None:
            there = [t for t in tasks if not t.gone.is_set()]  # others have no slot
            modes = {t: core.snapshot(t.facts.slot).mode for t in there}
            if any(modes.get(t) is not Mode.ON for t in self._news) or any(
                modes.get(t) in {Mode.ON, Mode.COMMAND} for t in self._olds
            ):
                slow()

        limit = longest_period(self._olds) + shortest_period(self._olds + self._news)
        return asyncio.get_running_loop().call_later(limit, report_late)

    async def _each(self, tasks: Sequence[Task], do: Step) -> None:
        errors = await asyncio.gather(
            *(do(task) for task in tasks), return_exceptions=True
        )
        for task, error in zip(tasks, errors, strict=True):
            if isinstance(error, PbonetError):
                self.failed.setdefault(task.name, error)
            elif error is not None:
                raise error

    async def _prepare(self, task: Task) -> None:
        """Let a task stand by; its predecessors call it."""
        self._rtpu.fallbacks.overtaken(task)
        olds = self._after[task.name]
        calls = await self._rtpu.successors.stand_by(task, olds, self._left)
        for old, call in zip(olds, calls, strict=True):
            self._calls[old].append(call)

    async def _learn(self, task: Task) -> None:
        """Let a task find the successors on other cores that it calls itself."""
        near, here = self._near(task), self._rtpu.core.core
        if any(call.core != here for call in near):
            await task.command(
                "calls", lambda n: rtpu_messages.Calls(n, near), self._left
            )

    async def _end(self, task: Task) -> None:
        """Let the task's next cycle be its last.

        For successors on other machines it gives its variables up: an owner is known to
        have ended there by the news that they have no owner.
        """
        await self._rtpu.successors.withdraw(task)
        cede, calls = not self._is_far(task), self._near(task)
        gone = await self._rtpu.fallbacks.turn_off(
            task,
            lambda n, then: rtpu_messages.Signal(
                n, "off", handover=True, cede=cede, calls=calls, then=then
            ),
            self._left,
            last=task.facts.rmod.tasktype is TaskType.PERIODIC,
        )
        self._ended.add(task.name)
        if gone:
            self._unheard.add(task.name)

    async def _come(self, task: Task) -> None:
        """Wait until the task has come on, unless one that hands over to it failed."""
        if not self.failed.keys() & set(self._after[task.name]):
            await self._rtpu.successors.come(task, self._left)
            self._came.add(task.name)

    async def _taken(self) -> None:
        """Wait a moment until successors on other RTPUs have taken over."""
        ended = [
            task
            for task in self._olds
            if task.state is State.OFF and task.name not in self._unheard
        ]
        end = time.monotonic() + TRIP + min(self._left, self._slowest)
        looks = 0  # a machine that stands still takes none of them
        while time.monotonic() < end or looks < round(TRIP / _LOOK):
            looks += 1
            if all(
                self._written(task, self._due(task, elsewhere=True)) for task in ended
            ):
                break
            await asyncio.sleep(_LOOK)

    def _near(self, task: Task) -> list[Call]:
        """Return the calls that a task makes itself."""
        return [call for call in self._calls[task.name] if not call.far]

    def _is_far(self, task: Task) -> bool:
        """Return whether the agent calls a successor, which is on another machine."""
        return any(call.far for call in self._calls[task.name])

    def _call_far(self) -> None:
        """Let the agent call successors on other machines; all is done here."""
        calls: list[Call] = []
        for task in self._olds:
            if task.name in self._ended:
                calls += [
                    structs.replace(call, outputs=_both(call, task))
                    for call in self._calls[task.name]
                    if call.far
                ]
        if calls and self._rtpu.call_far is not None:
            self._rtpu.call_far(self._olds[0].facts.subsystem, calls)

    def _due(self, task: Task, *, elsewhere: bool = False) -> list[str]:
        """Return which outputs of a task are written by those that it calls itself.

        Args:
            task: It leaves.
            elsewhere: Whether only those on other RTPUs count.
        """
        calls = self._near(task)
        if elsewhere:
            calls = [call for call in calls if call.successor not in self._after]
        return sorted({output for call in calls for output in _both(call, task)})

    def _written(self, task: Task, outputs: Sequence[str]) -> bool:
        return self._rtpu.flags.written(task.facts.subsystem, outputs)

    def _has_come(self, new: Task) -> bool:
        """Return whether a task has come on; it may have failed in a cycle since."""
        return new.name in self._came or new.state is State.ON

    def _has_rest(self, task: Task) -> bool:
        """Return whether a task owns variables that were not taken over."""
        return (
            task.state is State.OFF
            and not self._is_far(task)
            and not self._written(task, task.facts.outputs)
        )

    def _abandon(self) -> None:
        """Raise the flag for variables that no successor will take over any more.

        It goes up before the variables are given up, and before the state of successors
        that do not answer is known.
        """
        for task in self._olds:
            if task.state is State.OFF:
                subsystem = task.facts.subsystem
                self._rtpu.flags.handed_over(subsystem, task.name, self._due(task))

    async def _disown(self, task: Task) -> None:
        await task.command("disown", rtpu_messages.Disown, 1.0)

    @property
    def hanging(self) -> list[Task]:
        """Tasks for whose `off` the exchange no longer waits; see `late`."""
        return [one for one in self._olds if one.busy and not one.gone.is_set()]

    async def late(self, task: Task) -> bool:
        """Wait for an `off` that hangs; return whether it ended in order after all.

        No successor stands by any more, so the task gives up what it was to hand over.
        """
        await task.idle()
        if task.state is not State.OFF:
            return False
        if not task.stands_by:  # it may have become ready after `off`
            await rest(self._rtpu.core, task)
        await self._disown(task)
        return True

    def events(self) -> list[tuple[Task, lifecycle.Event, PbonetError | None]]:
        """Return the report on every task, in the order of the items."""
        tasks = {task.name: task for task in (*self._news, *self._olds)}
        return [
            (tasks[name], lifecycle.Event(signal), self.failed.get(name))
            for name, signal in self._items
        ]


def _both(call: Call, task: Task) -> list[str]:
    """Return what a task and the successor that it calls both write."""
    return [output for output in task.facts.outputs if output in call.outputs]
