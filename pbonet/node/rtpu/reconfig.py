"""Carries out an ordered list of signals on one RTPU (Stewart 1994, section 4.4.4).

Tasks that take each other's place do so together, at the dispatcher (`handover`); every
other signal is sent when the one before it has been answered.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError, StateError
from pbonet.node.wire import lifecycle
from pbonet.pbo import State
from pbonet.xm.net import MOST_EXTRA, Reconfigured

from .handover import TRIP, Exchange, plan, shortest_period
from .signal_tasks import control, note

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from pbonet.xm.net import Reconfig

    from .handover import Item
    from .rtpu_state import Rtpu
    from .task_handle import Task

RAISER = "reconfiguration"
CAUSE = "a reconfiguration takes longer than a cycle"


async def reconfigure(rtpu: Rtpu, request: Reconfig) -> Reconfigured:
    """Send signals in order; the first failure ends it.

    Raises:
        StateError: Another list of the subsystem is under way; nothing was sent.
    """
    subsystem = request.subsystem
    if items := rtpu.lists.get(subsystem):
        raise StateError(
            f"another list of subsystem {subsystem} is being carried out",
            where=rtpu.name,
            expected="one at a time",
            got=", ".join(f"{signal} {task}" for task, signal in items),
            remedy="wait until it has been answered; nothing was sent",
        )
    rtpu.lists[subsystem] = request.items
    try:
        return await _List(rtpu, request).run()
    finally:
        del rtpu.lists[subsystem]


class _List:
    """A list that is carried out."""

    def __init__(self, rtpu: Rtpu, request: Reconfig) -> None:
        self._rtpu = rtpu
        self._request = request
        self._result = Reconfigured(done=0)
        self._slow = _Slow(rtpu, request.subsystem)
        self._handed: dict[str, Collection[str]] = {**request.handover}
        """Variables that tasks of the list leave for later ones, by task."""

    async def run(self) -> Reconfigured:
        """Carry it out, as far as it goes."""
        items = self._request.items
        begin = 0
        done: list[Item] = []
        try:
            while begin < len(items):
                left, length = await self._next(items[begin:])
                rest = items[begin + length :]
                step = items[begin : begin + length]
                done += [item for item in step if item not in left]
                if left:
                    self._result.rest = [*left, *rest]
                    break
                begin += length
        finally:
            self._slow.end()
            if begin == len(items):  # else what was before it stands as it stood
                named = {name for name, _ in items}
                self._rtpu.flags.decided(
                    self._request.subsystem, named.union(self._request.handover)
                )
            self._expect_others(done)
        self._result.done = len(items) - len(self._result.rest)
        return self._result

    async def _next(self, items: Sequence[Item]) -> tuple[list[Item], int]:
        """Carry out the next step; return its undone items, and its length."""
        request = self._request
        after = plan(self._rtpu, request.subsystem, items, request.calls)
        if after:
            return await self._exchange(after), len(after)
        return await self._one(items[0], items[1:]), 1

    def _expect_others(self, done: Sequence[Item]) -> None:
        """Raise the flag if those that take over on other RTPUs do not come.

        A master that has died amid its list sends no more. This RTPU's part is done,
        and its entry says what is not.
        """
        rtpu, request = self._rtpu, self._request
        subsystem = request.subsystem
        # After a failure the master sends nothing more.
        within = 0.0 if self._result.error else TRIP
        for name, signal in done:
            task = rtpu.tasks.get((subsystem, name))
            if signal == "off" and task is not None:
                handed = request.handover.get(name, ())
                outputs = [one for one in task.facts.outputs if one in handed]
                rtpu.flags.handed_over(subsystem, name, outputs, within)

    async def _one(self, item: Item, rest: Sequence[Item]) -> list[Item]:
        """Send one signal; return it when that failed."""
        name, signal = item
        request = self._request
        if signal == "kill" and (request.subsystem, name) in self._rtpu.tombs:
            self._rtpu.bury(request.subsystem, name)
            self._result.states[name] = State.NOT_CREATED.value
            return []
        try:
            task = self._rtpu.need(request.subsystem, name)
            if signal == "on" and await self._rtpu.successors.asked(task):
                await self._come(task)
                return []
            if signal == "on" or task.state is State.ON:  # else no inputs change
                self._slow.begin()
            goes = signal == "off" and (
                name in request.handover or self._has_successor(task, rest)
            )
            comes = signal == "on" and self._has_predecessor(task)
            await control(
                self._rtpu,
                task,
                signal,
                request.timeout,
                handover=goes or comes,
                extra=MOST_EXTRA * request.timeout,
            )
            if goes:
                self._handed.setdefault(name, task.facts.outputs)
        except PbonetError as error:
            self._result.error = error.to_wire()
            return [item]
        self._result.states[name] = task.state.value
        return []

    async def _come(self, task: Task) -> None:
        """Wait until a task that stands by for others elsewhere has come on.

        Raises:
            PbonetError: It did not.
        """
        failed: PbonetError | None = None
        try:
            await self._rtpu.successors.come(task, self._request.timeout)
        except PbonetError as error:
            failed = error
            await self._rtpu.successors.give_up(task)
            raise
        finally:
            note(self._rtpu, task, lifecycle.Event.ON, failed)
            self._result.states[task.name] = task.state.value

    async def _exchange(self, after: Mapping[str, list[str]]) -> list[Item]:
        """Exchange tasks; return what was not done, that which failed first."""
        request = self._request
        subsystem = request.subsystem
        made = Exchange(
            self._rtpu,
            subsystem,
            after,
            request.timeout,
            request.calls,
            slowest=request.slowest,
        )
        await made.run(self._slow.up)
        for task, event, error in made.events():
            self._result.states[task.name] = task.state.value
            on = event is lifecycle.Event.ON
            if error is not None or task.state is (State.ON if on else State.OFF):
                note(self._rtpu, task, event, error, ranked=True)
        self._rtpu.rank()
        for task in made.hanging:
            cause = f"{task.name} hangs in off"
            self._rtpu.flags.up(subsystem, task.name, cause)
            self._rtpu.later(self._late(made, task), f"off of {task.name}")
        undone = made.undone
        if undone and made.failed:
            first = made.failed.get(undone[0][0]) or next(iter(made.failed.values()))
            self._result.error = first.to_wire()
        return undone

    async def _late(self, made: Exchange, task: Task) -> None:
        """Note an `off` that ends when it is no longer waited for."""
        with contextlib.suppress(PbonetError):  # it died: reported elsewhere
            if await made.late(task):
                note(self._rtpu, task, lifecycle.Event.OFF)

    def _has_successor(self, task: Task, rest: Sequence[Item]) -> bool:
        """Return whether a task that is turned on later in the list takes an output."""
        mine = set(task.facts.outputs)
        for name, signal in rest:
            other = self._rtpu.tasks.get((task.facts.subsystem, name))
            if other is None or signal != "on":
                continue
            if mine & set(other.facts.outputs):
                return True
        return False

    def _has_predecessor(self, task: Task) -> bool:
        """Return whether another task of the list left an output, here or elsewhere."""
        mine = set(task.facts.outputs)
        return any(
            mine.intersection(theirs)
            for name, theirs in self._handed.items()
            if name != task.name
        )


class _Slow:
    """Raises the illegal-configuration flag while a list takes longer than a cycle.

    Args:
        rtpu: Where it is carried out.
        subsystem: The flag's subsystem.
    """

    def __init__(self, rtpu: Rtpu, subsystem: str) -> None:
        self._rtpu = rtpu
        self._subsystem = subsystem
        self._timer: asyncio.TimerHandle | None = None
        self._up = False

    def begin(self) -> None:
        """From here on the configuration may be illegal; harmless if it was so."""
        if self._timer is None:
            period = shortest_period(self._rtpu.of(self._subsystem))
            self._timer = asyncio.get_running_loop().call_later(period, self.up)

    def up(self) -> None:
        """It does take longer."""
        self._up = True
        self._rtpu.flags.up(self._subsystem, RAISER, CAUSE)

    def end(self) -> None:
        """The list is done, or was given up."""
        if self._timer is not None:
            self._timer.cancel()
        if self._up:
            self._rtpu.flags.down(self._subsystem, RAISER)
