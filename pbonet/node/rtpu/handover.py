"""Exchanges tasks at the dispatcher: the new ones are released as the old ones end.

Everything that can be done beforehand is: the new task stands by, OFF, and has been
found able to take over (Stewart 1994, section 3.10). Then the old one is told that its
next cycle is its last. Behind that, still at the level of its cycles, its `off` runs;
the dispatcher sees it leave and grants the new one its `on`, which takes the variables
over as one event; its first cycle is released on the next point of the grid. From the
word on no message is waited for, neither of the network nor between processes.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from pbonet.analysis.schedule import Mode
from pbonet.config import TaskType
from pbonet.errors import PbonetError
from pbonet.node import rt
from pbonet.node.wire import lifecycle, rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import Call

from .fallbacks import End, come, rest, stand_by

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

    from .rtpu_state import Rtpu
    from .task_handle import Task

    Step = Callable[[Task], Awaitable[None]]

Item = tuple[str, str]
TRIP = 0.05
"""Seconds in which what is on its way to another RTPU should have come."""
_LOOK = 0.001
_NOBODY: dict[str, list[Call]] = {}


def exchanges(rtpu: Rtpu, subsystem: str, items: Sequence[Item]) -> int:
    """Return how many items at the beginning are carried out together; at least 1.

    Items belong together when they stand side by side and each is one of these: an
    ``off`` of a task that is ON and whose variables a later one of them takes over, or
    the ``on`` of a task that takes variables over from an earlier one.
    """
    end = 0
    while end < len(items) and _alike(rtpu, subsystem, items[: end + 1]):
        end += 1
    while end > 1 and not _closed(rtpu, subsystem, items[:end]):
        end -= 1
    return max(end, 1)


def _alike(rtpu: Rtpu, subsystem: str, items: Sequence[Item]) -> bool:
    """Tell whether the last item may belong to an exchange with those before it."""
    name, signal = items[-1]
    task = rtpu.tasks.get((subsystem, name))
    if task is None or name in {one for one, _ in items[:-1]}:
        return False
    wanted = {"off": State.ON, "on": State.OFF}.get(signal)
    return task.state is wanted and bool(task.facts.outputs) and not task.busy


def _closed(rtpu: Rtpu, subsystem: str, items: Sequence[Item]) -> bool:
    """Tell whether everybody has an heir, or is one."""
    heirs = _heirs(rtpu, subsystem, items)
    going = {name for name, signal in items if signal == "off"}
    return all(heirs.values()) and going == set().union(*heirs.values(), set())


def _heirs(rtpu: Rtpu, subsystem: str, items: Sequence[Item]) -> dict[str, list[str]]:
    """Return for each task that comes which of those before it hand over to it."""
    found: dict[str, list[str]] = {}
    gone: dict[str, set[str]] = {}
    for name, signal in items:
        outputs = set(rtpu.need(subsystem, name).facts.outputs)
        if signal == "off":
            gone[name] = outputs
        else:
            found[name] = [old for old, theirs in gone.items() if theirs & outputs]
    return found


def shortest_period(tasks: Iterable[Task]) -> float:
    """Return the period of the fastest of the tasks that are ON, in seconds."""
    rates = [task.freq for task in tasks if task.state is State.ON and task.freq]
    return 1.0 / max(rates, default=1.0)


def longest_period(tasks: Iterable[Task]) -> float:
    """Return the period of the slowest of the tasks that have one, in seconds."""
    return 1.0 / min((t.freq for t in tasks if t.freq), default=1.0)


def calling(items: Sequence[Item], calls: Mapping[str, list[Call]]) -> int:
    """Return how many items at the beginning are ``off`` of tasks that call."""
    length = 0
    while (
        length < len(items)
        and items[length][1] == "off"
        and (items[length][0] in calls)
    ):
        length += 1
    return length


class Exchange:
    """One exchange under way.

    Args:
        rtpu: Where all tasks are.
        subsystem: Whose they are.
        items: ``off`` and ``on`` items, as `exchanges` has found them.
        limit: Seconds that each step may take.
        calls: For tasks that leave whom of other RTPUs they call; then all of them do.
        slowest: Seconds in which tasks of other RTPUs leave for the same heirs.
    """

    def __init__(
        self,
        rtpu: Rtpu,
        subsystem: str,
        items: Sequence[Item],
        limit: float,
        calls: Mapping[str, list[Call]] = _NOBODY,
        *,
        slowest: float = 0.0,
    ) -> None:
        self._rtpu = rtpu
        self._items = items
        self._deadline = time.monotonic() + limit
        self._after = {
            name: [rtpu.need(subsystem, old) for old in olds]
            for name, olds in _heirs(rtpu, subsystem, items).items()
        }
        tasks = {name: rtpu.need(subsystem, name) for name, _ in items}
        self._news = [tasks[name] for name, signal in items if signal == "on"]
        self._olds = [tasks[name] for name, signal in items if signal == "off"]
        self._calls = calls
        self._slowest = slowest
        self._came: set[str] = set()
        """Tasks that have come on; one may have failed in a cycle since."""
        self._ended: set[str] = set()
        """Tasks that have ended in order; one may have been engaged since."""
        self._unheard: set[str] = set()
        """Tasks that have ended and whose heirs elsewhere were not there any more."""
        self.failed: dict[str, PbonetError] = {}
        """What went wrong, by task."""
        self.unseen: list[str] = []
        """Heirs that cannot be called from here; then nothing was done."""

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
        """Carry it out; what went wrong is in `failed`.

        Args:
            slow: Called when it takes longer than a cycle of the slowest task that
                leaves, and one more.
        """
        self._rtpu.rank(*self._news)
        await self._each(self._news, self._prepare)
        if self._calls:
            near = [task for task in self._olds if not self._is_far(task)]
            await self._each(near, self._send_heralds)
        if not self.failed and not self.unseen:
            timer = self._watched(slow)
            try:
                await self._each(self._olds, self._end)
                self._call_far()
                await self._each(self._news, self._come)
                await self._taken()
            finally:
                timer.cancel()
        self._abandon()
        # First, for one that was engaged all the same finds its variables free then.
        await self._each([t for t in self._olds if self._has_rest(t)], self._disown)
        for task in self._news:
            if not self._has_come(task):
                await self._rtpu.fallbacks.spare(task)
                if task.state is State.OFF:
                    await rest(self._rtpu, task)

    def _watched(self, slow: Callable[[], None]) -> asyncio.TimerHandle:
        """Have `slow` called unless all new tasks are armed by then."""
        core, tasks = self._rtpu.core, (*self._news, *self._olds)

        def look() -> None:
            there = [t for t in tasks if not t.gone.is_set()]  # others have no slot
            modes = {t: core.snapshot(t.facts.slot).mode for t in there}
            if any(modes.get(t) is not Mode.ON for t in self._news) or any(
                modes.get(t) in {Mode.ON, Mode.COMMAND} for t in self._olds
            ):
                slow()

        limit = longest_period(self._olds) + shortest_period(self._olds + self._news)
        return asyncio.get_running_loop().call_later(limit, look)

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
        await self._rtpu.heirs.withdraw(task)
        await self._rtpu.fallbacks.withdraw(task)
        self._rtpu.fallbacks.overtaken(task)
        task.engaged = asyncio.get_running_loop().create_future()
        after = self._after[task.name]
        await stand_by(self._rtpu, task, End(rt.HANDOVER, after), self._left)
        await self._rtpu.fallbacks.ready(task, [old.name for old in after])

    async def _send_heralds(self, task: Task) -> None:
        calls = self._calls.get(task.name, [])
        done = await task.command(
            "herald", lambda n: rtpu_messages.Herald(n, calls), self._left
        )
        self.unseen += done.result

    async def _end(self, task: Task) -> None:
        """Let the task's next cycle be its last.

        For heirs on other machines it gives its variables up: an owner is known to have
        ended there by the news that nobody owns them any more.
        """
        await self._rtpu.heirs.withdraw(task)
        far = self._is_far(task)
        done = await self._rtpu.fallbacks.turn_off(
            task,
            lambda n: rtpu_messages.Signal(n, "off", handover=True, cede=not far),
            self._left,
            last=task.facts.rmod.tasktype is TaskType.PERIODIC,
            heirs={
                new: [old.name for old in olds] for new, olds in self._after.items()
            },
        )
        self._ended.add(task.name)
        if done.result and not far:
            self._unheard.add(task.name)

    async def _come(self, task: Task) -> None:
        """Wait until the task has come on, unless who should hand over failed."""
        if task.engaged is None or any(
            old.name in self.failed for old in self._after[task.name]
        ):
            return
        await come(task, self._left)
        self._came.add(task.name)

    async def _taken(self) -> None:
        """Wait a moment until heirs on other RTPUs have taken over what is theirs."""
        ended = [
            task
            for task in self._olds
            if task.state is State.OFF and task.name not in self._unheard
        ]
        end = time.monotonic() + TRIP + min(self._left, self._slowest)
        looks = 0  # a machine that stands still takes none of them
        while time.monotonic() < end or looks < round(TRIP / _LOOK):
            looks += 1
            if all(self._written(task, self._called_for(task)) for task in ended):
                break
            await asyncio.sleep(_LOOK)

    def _is_far(self, task: Task) -> bool:
        """Tell whether a task's heirs are on other machines, and called from there."""
        calls = self._calls.get(task.name, ())
        return bool(calls) and all(call.far for call in calls)

    def _call_far(self) -> None:
        """Have those called that are on other machines; here all is done for them."""
        ended = [one for one in self._olds if one.name in self._ended]
        calls = [c for one in ended if self._is_far(one) for c in self._calls[one.name]]
        if calls and self._rtpu.call_far is not None:
            self._rtpu.call_far(ended[0].facts.subsystem, calls)

    def _called_for(self, task: Task) -> list[str]:
        """Return what those write that a task calls itself."""
        calls = () if self._is_far(task) else self._calls.get(task.name, ())
        theirs = {output for call in calls for output in call.outputs}
        return [output for output in task.facts.outputs if output in theirs]

    def _written(self, task: Task, outputs: Sequence[str]) -> bool:
        subsystem = task.facts.subsystem
        return self._rtpu.flags.written(subsystem, outputs, but=task.name)

    def _has_come(self, new: Task) -> bool:
        """Tell whether a task has come on; in a cycle since it may have failed."""
        return new.name in self._came or new.state is State.ON

    def _has_rest(self, task: Task) -> bool:
        """Tell whether a task owns what nobody has taken over."""
        if task.state is not State.OFF or self._is_far(task):
            return False
        if self._calls:
            return not self._written(task, task.facts.outputs)
        taken = {
            output
            for new in self._news
            if self._has_come(new)
            for output in new.facts.outputs
        }
        return not taken.issuperset(task.facts.outputs)

    def _abandon(self) -> None:
        """Raise the flag for what nobody has taken over, and will not any more.

        It goes up before the variables are given up, and before it is known what has
        become of heirs that do not answer.
        """
        late = [new for new in self._news if new.name not in self._came]
        heirs = {output for new in late for output in new.facts.outputs}
        for task in self._olds:
            if task.state is not State.OFF:
                continue
            due = heirs.union(self._called_for(task))
            mine = [output for output in task.facts.outputs if output in due]
            left = [output for output in mine if not self._written(task, [output])]
            if left:
                subsystem = task.facts.subsystem
                self._rtpu.flags.abandoned(subsystem, task.name, left)
        for task in late:
            if task.gone.is_set() and not task.stopping:
                self._rtpu.heirs.died(task, ended=True)

    async def _disown(self, task: Task) -> None:
        await task.command("disown", rtpu_messages.Disown, 1.0)

    @property
    def hanging(self) -> list[Task]:
        """Tasks whose `off` nobody waits for any more; see `late`."""
        return [one for one in self._olds if one.busy and not one.gone.is_set()]

    async def late(self, task: Task) -> bool:
        """Wait for an `off` that hangs; return whether it ended in order after all.

        Nobody stands by any more, so the task gives up what it was to hand over.
        """
        await task.idle()
        if task.state is not State.OFF:
            return False
        if not task.stands_by:  # it may have got ready behind its `off`
            await rest(self._rtpu, task)
        await self._disown(task)
        return True

    def events(self) -> list[tuple[Task, lifecycle.Event, PbonetError | None]]:
        """Return what there is to be told of every task, in the order of the items."""
        tasks = {task.name: task for task in (*self._news, *self._olds)}
        return [
            (tasks[name], lifecycle.Event(signal), self.failed.get(name))
            for name, signal in self._items
        ]
