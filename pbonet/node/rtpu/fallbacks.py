"""Standbys: a task that is engaged when another one fails (a job's FALLBACK).

The dispatcher engages it, alone and at once (``standby.h``). This file only arranges
beforehand which task stands by, and reports afterwards what has happened. A pair is
arranged while the original is ON and the standby OFF, and whenever the original is
about to come on.

A standby of a task on another RTPU is turned ON by its agent, when that task has been
lost for a declared time. Nothing is arranged for that: its ``on`` is that of any task,
and is refused while its variables are written.

Nothing flaps: an original that is cleared does not take its place back, a standby that
fails too has no further standby, and after `LIMIT` times a pair is not arranged again.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Protocol

from msgspec import Struct

from pbonet.analysis.schedule import Mode
from pbonet.errors import PbonetError, Severity, StateError
from pbonet.node.wire import rtpu_messages
from pbonet.pbo import State

from .task_handle import rest

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.node import rt
    from pbonet.node.wire import EventLog

    from .task_handle import Task

LIMIT = 3
"""How often a standby is engaged before an operator is needed."""
TIME = 2.0
"""Seconds that a standby may take to get ready, and to receive the request for it."""


class Pair(Struct):
    """An original and its standby."""

    subsystem: str
    original: str
    standby: str
    engaged: int = 0
    """How often the standby had to come on."""
    told: str = ""
    """The last reported reason why it cannot stand by."""
    arranged: Task | None = None
    """The original that the standby waits for, or has waited for last."""
    rtpu: str = ""
    """The RTPU of the original, if it is another one."""
    takeover: float = 0.0
    """Seconds without that original until the standby is turned ON; 0: never."""
    ready: bool = False
    """Whether the loss of an original on another RTPU counts: it was turned ON, and not
    off by an order."""


class Home(Protocol):
    """The part of the RTPU that is needed here."""

    name: str
    core: rt.CoreTable
    events: EventLog
    tasks: dict[tuple[str, str], Task]
    stopping: set[str]
    lists: dict[str, list[tuple[str, str]]]

    def publish_claims(self) -> None:
        """Tell the agent what has changed."""
        ...

    def of(self, subsystem: str) -> list[Task]:
        """Return the tasks of a subsystem."""
        ...

    def need(self, subsystem: str, name: str) -> Task:
        """Return a task, or raise UnknownTaskError."""
        ...


class Fallbacks:
    """The pairs of one RTPU.

    Args:
        rtpu: Whose.
    """

    def __init__(self, rtpu: Home) -> None:
        self._rtpu = rtpu
        self._pairs: dict[tuple[str, str], Pair] = {}
        self._running: set[asyncio.Task[None]] = set()
        self._lock = asyncio.Lock()

    async def pair(
        self,
        subsystem: str,
        standby: str,
        original: str,
        *,
        rtpu: str = "",
        takeover: float = 0.0,
        ready: bool = False,
    ) -> None:
        """Make a task the fallback of another one; an empty original ends that.

        Args:
            subsystem: Of both tasks.
            standby: The one.
            original: The other one.
            rtpu: Its RTPU, if it is another one.
            takeover: Seconds without it after which the standby is turned ON; 0: never.
            ready: Whether its loss counts from now on.

        Raises:
            UnknownTaskError: One of them is not here.
            StateError: They are the same task.
            PbonetError: The standby could not take over: why.
        """
        task = self._rtpu.need(subsystem, standby)
        if original and not rtpu:
            self._rtpu.need(subsystem, original)
        if original == standby:
            raise StateError(
                f"the task {standby} cannot be its own fallback",
                where=self._rtpu.name,
                remedy="name another task",
            )
        known = self._pairs.get((subsystem, standby))
        if (
            known is not None
            and (known.original, known.rtpu) == (original, rtpu)
            and known.engaged < LIMIT
        ):
            known.takeover, known.ready = takeover, ready
            self._publish_away(known)
            await self._arrange(known)
            return
        await self.withdraw(task)
        if known is not None:
            del self._pairs[subsystem, standby]
            self._publish_away(known)
        if not original:
            return
        made = Pair(
            subsystem, original, standby, rtpu=rtpu, takeover=takeover, ready=ready
        )
        self._pairs[subsystem, standby] = made
        self._publish_away(made)
        await self._arrange(made)

    def of(self, task: Task) -> Pair | None:
        """Return a task and its original if it is a fallback."""
        return self._pairs.get((task.facts.subsystem, task.name))

    def missed(self, task: Task) -> list[str]:
        """Return which of its variables others must write when a task has failed.

        Where it has a fallback these are what both write: the configuration was judged
        with the one in the place of the other.
        """
        outputs = task.facts.outputs
        for pair in self._pairs.values():
            if (pair.subsystem, pair.original) == (task.facts.subsystem, task.name):
                other = self._rtpu.tasks.get((pair.subsystem, pair.standby))
                if other is not None:
                    theirs = other.facts.outputs
                    return [output for output in outputs if output in theirs]
        return outputs

    def forget(self, subsystem: str) -> None:
        """Forget all pairs of a subsystem."""
        for key in [key for key in self._pairs if key[0] == subsystem]:
            del self._pairs[key]

    # -- for tasks of other RTPUs ------------------------------------------------------

    def away(self) -> list[rtpu_messages.Standby]:
        """Return the standbys whose originals the agent watches."""
        return [
            rtpu_messages.Standby(
                subsystem=pair.subsystem,
                standby=pair.standby,
                original=pair.original,
                rtpu=pair.rtpu,
                takeover=pair.takeover,
                outputs=tuple(task.facts.outputs),
            )
            for key, pair in self._pairs.items()
            if pair.takeover
            and (task := self._rtpu.tasks.get(key)) is not None
            and self.stands_away(task)
        ]

    def stands_away(self, task: Task) -> bool:
        """Return whether a task stands by for one of another RTPU."""
        pair = self.of(task)
        return (
            pair is not None
            and bool(pair.rtpu)
            and pair.ready
            and pair.engaged < LIMIT
            and task.state is State.OFF
        )

    def takes_over(self, task: Task) -> None:
        """Note that a task comes in the place of one of another RTPU."""
        pair = self.of(task)
        if pair is not None:
            pair.engaged, pair.ready = pair.engaged + 1, False
            self._publish_away(pair)

    def report_away(self, task: Task, why: str, error: PbonetError | None) -> None:
        """Report how a task has come in the place of one of another RTPU."""
        pair = self.of(task)
        if pair is None:
            return
        self._report(
            Severity.WARNING if error is None else Severity.ERROR,
            pair,
            f"{pair.original} on {pair.rtpu} is lost, {why}: its fallback {task.name} "
            f"was turned on; state {task.state}, time {pair.engaged} of {LIMIT}"
            + (f": {error}" if error is not None else ""),
        )

    def _publish_away(self, pair: Pair) -> None:
        """Tell the agent which originals to watch, if that may have changed."""
        if pair.rtpu:
            self._rtpu.publish_claims()

    # -- standing by -------------------------------------------------------------------

    async def ready(self, original: Task, after: Sequence[str] = ()) -> None:
        """Let the fallbacks stand by for a task that is about to come on.

        It may fail in its first cycle.

        Args:
            original: The task.
            after: Tasks that own its out-vars until then.
        """
        for pair in list(self._pairs.values()):
            if (pair.subsystem, pair.original) == (
                original.facts.subsystem,
                original.name,
            ):
                with contextlib.suppress(PbonetError):  # reported when the task is ON
                    await self._arrange(pair, after, coming=True)

    def update(self, task: Task) -> None:
        """Arrange or dissolve pairs, as the state of one of the two has changed."""
        for pair in list(self._pairs.values()):
            if task.facts.subsystem == pair.subsystem and task.name in {
                pair.original,
                pair.standby,
            }:
                self._publish_away(pair)
                self._later(pair)

    def update_all(self) -> None:
        """Update every pair, because what was in the way may be gone."""
        for pair in list(self._pairs.values()):
            self._later(pair)

    def _later(self, pair: Pair) -> None:
        if not self._due(pair):
            return
        running = asyncio.create_task(self._quietly(pair), name="fallback")
        self._running.add(running)
        running.add_done_callback(self._running.discard)

    async def _quietly(self, pair: Pair) -> None:
        try:
            await self._arrange(pair)
        except PbonetError as error:
            if str(error) != pair.told:
                pair.told = str(error)
                self._report(Severity.WARNING, pair, f"cannot stand by: {error}")

    def _due(self, pair: Pair, *, coming: bool = False) -> bool:
        """Return whether the standby should stand by now, and does not.

        Args:
            pair: The two.
            coming: The original is about to come on, if it has not yet.
        """
        both = self._both(pair)
        if both is None:
            return False
        standby, original = both
        return (
            not (standby.stands_by and pair.arranged is original)
            and standby.state is State.OFF
            and not self._succeeds(standby)
            and self._unengaged(standby)
            and self._unfallen(original, coming=coming)
        )

    def _both(self, pair: Pair) -> tuple[Task, Task] | None:
        """Return the standby and its original if the one is for the other still."""
        standby = self._rtpu.tasks.get((pair.subsystem, pair.standby))
        original = self._rtpu.tasks.get((pair.subsystem, pair.original))
        if (
            self._pairs.get((pair.subsystem, pair.standby)) is not pair
            or standby is None
            or original is None
            or pair.engaged >= LIMIT
            or pair.subsystem in self._rtpu.stopping
            or standby.stopping
            or original.stopping
        ):
            return None
        return standby, original

    def _succeeds(self, standby: Task) -> bool:
        """Return whether a list is about to turn a task on, here or elsewhere."""
        listed = self._rtpu.lists.get(standby.facts.subsystem, ())
        return (standby.name, "on") in listed or standby.waiting is not None

    def _unengaged(self, standby: Task) -> bool:
        """Return whether the dispatcher suspends a task and has not reported it yet."""
        slot = self._rtpu.core.snapshot(standby.facts.slot)
        return slot.mode in {Mode.OFF, Mode.STANDS} and not slot.comes

    def _unfallen(self, original: Task, *, coming: bool) -> bool:
        """Return whether the standby of a task was not engaged by a past failure."""
        slot = self._rtpu.core.snapshot(original.facts.slot)
        if original.state is State.ON:
            return not slot.dead
        return coming and original.state is State.OFF and not (slot.dead or slot.fell)

    async def _arrange(
        self, pair: Pair, after: Sequence[str] = (), *, coming: bool = False
    ) -> None:
        async with self._lock:
            if not self._due(pair, coming=coming):
                return
            standby = self._rtpu.need(pair.subsystem, pair.standby)
            original = self._rtpu.need(pair.subsystem, pair.original)
            self._follow(pair, standby, original)
            names, owners = [original.name], list(after)
            try:
                await standby.command(
                    "prepare", lambda n: rtpu_messages.Prepare(n, names, owners), TIME
                )
            except BaseException:
                self.dismiss(standby)
                raise
            pair.told = ""

    def _follow(self, pair: Pair, standby: Task, original: Task) -> None:
        """Let the dispatcher engage a task that stands by when its original fails."""
        standby.stands_by, pair.arranged = pair.original, original
        self._rtpu.core.follow(standby.facts.slot, [original.facts.slot])

    async def turn_off(
        self,
        task: Task,
        off: Callable[[int, rtpu_messages.Prepare | None], rtpu_messages.Signal],
        limit: float,
        *,
        last: bool,
    ) -> list[str]:
        """Turn off a task that hands over, and let it stand by for its own original.

        If that is its successor, the successor may fail in its first cycle, before the
        end of this task's `off` is reported. So the task goes directly from its `off`
        to standing by.

        Args:
            task: It is ON.
            off: Makes the message from its number and from what follows the `off`.
            limit: Seconds that its `off` may take.
            last: It comes after the task's next cycle.

        Returns:
            Successors that the task called and that have died.

        Raises:
            PbonetError: As `Task.command`.
        """
        then = self._turn_back(task)
        try:
            done = await task.command("off", lambda n: off(n, then), limit, last=last)
        except PbonetError:
            if then is not None:
                await self._stay(task)
            raise
        gone: list[str]
        gone, stands = done.result
        if then is not None and not stands:
            await self._stay(task)
        return gone

    def _turn_back(self, task: Task) -> rtpu_messages.Prepare | None:
        """Arrange that a task stands by for its original, to which it hands over.

        Returns:
            What the task needs for that; None: it does not stand by.
        """
        pair = self._pairs.get((task.facts.subsystem, task.name))
        both = self._both(pair) if pair is not None else None
        if pair is None or both is None:
            return None
        original = both[1]
        owners = [*original.waiting.after] if original.waiting is not None else []
        coming = original.state is State.OFF and task.name in owners
        if not (coming and self._unfallen(original, coming=True)):
            return None
        self._follow(pair, task, original)
        return rtpu_messages.Prepare(0, [original.name], owners)

    async def _stay(self, task: Task) -> None:
        """Cancel the standby of a task that could not be turned off or made ready."""
        task.stands_by = ""
        if not task.gone.is_set():
            await rest(self._rtpu.core, task)

    async def withdraw(self, task: Task) -> None:
        """End the standby of a task, if any, because it gets a signal itself."""
        async with self._lock:
            if task.stands_by:
                self.dismiss(task)
                await task.command("rest", lambda n: rtpu_messages.Prepare(n, []), TIME)

    async def spare(self, task: Task) -> None:
        """Engage no fallback for a task that will be ended on purpose."""
        for other in self._rtpu.of(task.facts.subsystem):
            if other.stands_by == task.name:
                with contextlib.suppress(PbonetError):  # one that hangs in its `on`
                    await self.withdraw(other)

    def overtaken(self, task: Task) -> None:
        """Keep fallbacks within their `on` from taking outputs of a task that comes on.

        Args:
            task: Is about to come on, and writes what they would.
        """
        mine = set(task.facts.outputs)
        for other in self._rtpu.of(task.facts.subsystem):
            slot = other.facts.slot
            if (
                other.stands_by
                and other is not task
                and mine.intersection(other.facts.outputs)
                and self._rtpu.core.snapshot(slot).comes
            ):  # it goes on standing by, so its notice is that of a fallback
                self._rtpu.core.follow(slot, [])

    def dismiss_all(self, subsystem: str) -> None:
        """Engage no task any more, because the subsystem is being stopped."""
        for task in self._rtpu.of(subsystem):
            self.dismiss(task)

    def dismiss(self, task: Task) -> None:
        """Keep a task from being engaged, without a message: it is being ended."""
        if task.stands_by:
            self._rtpu.core.follow(task.facts.slot, [])
            task.stands_by = ""

    # -- engaged -----------------------------------------------------------------------

    def engaged(self, task: Task, notice: rtpu_messages.Notice) -> None:
        """Report that the dispatcher engaged a standby, and the result."""
        pair = self._pairs.get((task.facts.subsystem, task.name))
        if pair is None or not task.stands_by:
            return
        task.stands_by = ""
        self._rtpu.core.follow(task.facts.slot, [])
        pair.engaged += 1
        original = self._rtpu.tasks.get((pair.subsystem, pair.original))
        dead = original is None or self._rtpu.core.snapshot(original.facts.slot).dead
        why = "has died" if dead else "is in ERROR"
        good = task.state is State.ON
        self._report(
            Severity.WARNING if good else Severity.ERROR,
            pair,
            f"{pair.original} {why}: its fallback {task.name} was released by the "
            f"dispatcher; state {task.state}, time {pair.engaged} of {LIMIT}"
            + ("" if good else f"; no task writes its variables: {notice.text}")
            + (f"; {task.name} will not stand by again" * (pair.engaged >= LIMIT)),
        )

    def _report(self, severity: Severity, pair: Pair, text: str) -> None:
        self._rtpu.events.add(
            severity,
            "FALLBACK",
            text,
            subsystem=pair.subsystem,
            task=pair.standby,
        )
