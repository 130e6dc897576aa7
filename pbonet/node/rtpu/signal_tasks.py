"""Sends signals to tasks, singly, in lists, and all at once (Stewart 1994, 4.5.3)."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections import deque
from typing import TYPE_CHECKING

from pbonet.errors import (
    MethodError,
    NoAnswerError,
    PbonetError,
    Severity,
    StateError,
    TaskDiedError,
    UnknownTaskError,
)
from pbonet.node.wire import being_stopped, lifecycle, rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import Stopped, event_codes

from .task_handle import END_TIME

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.node.wire import Neighbours

    from .rtpu_state import Rtpu
    from .task_handle import Make, Task

OFF_SHARE = 0.6
"""Of the time for a stop, what turning OFF may take; the rest is for ending."""
TAKEOVER_TIME = 5.0
"""Seconds for the `on` of a task that takes over."""
ORDER_TIME = 5.0
"""Seconds for a signal that a module sends to another task."""
NEIGHBOUR_TIME = 1.0
"""Seconds more for another RTPU of the machine to answer what became of it."""
MOST_ORDERS = 16
"""Signals of one task's module that wait for another task."""
LEAST = 0.05
"""Seconds that each task gets for its `off`, however many there are."""


def event_of(signal: str, where: str) -> lifecycle.Event:
    """Return the signal that a master named.

    Raises:
        StateError: There is none of that name.
    """
    with contextlib.suppress(ValueError):
        event = lifecycle.Event(signal)
        if event in lifecycle.FROM_OUTSIDE:
            return event
    raise StateError(
        f"there is no signal {signal!r}",
        where=where,
        expected=" or ".join(lifecycle.FROM_OUTSIDE),
        remedy="send one of these",
    )


async def control(
    rtpu: Rtpu,
    task: Task,
    signal: str,
    limit: float,
    *,
    arg: str = "",
    handover: bool = False,
    replaces: Sequence[str] = (),
    extra: float = 0.0,
) -> list[str]:
    """Send one signal and wait for the state it leads to; return warnings.

    `extra` is as in `Task.wait_for`; a `kill` does not use it.

    Raises:
        StateError: It is not valid in the task's state; nothing was sent.
        PbonetError: What the task answered, or why it did not answer.
    """
    event = event_of(signal, task.name)
    if event is lifecycle.Event.KILL:
        task.stopping = True  # from here on no task gets ready for it
        await rtpu.fallbacks.spare(task)
        rtpu.fallbacks.dismiss(task)  # nothing is asked of it: it may hang in `on`
        rtpu.successors.dismiss(task)
        return await kill(rtpu, task, limit, arg=arg)

    def make(n: int) -> rtpu_messages.Signal:
        return rtpu_messages.Signal(
            n, signal, arg=arg, handover=handover, replaces=list(replaces)
        )

    done = asyncio.Event()
    if event is lifecycle.Event.ON:
        task.coming.append(done)
    try:
        await _send(rtpu, task, event, make, limit, extra=extra)
    finally:
        done.set()
        if event is lifecycle.Event.ON:
            task.coming.remove(done)
    return []


def obey(rtpu: Rtpu, sender: Task, name: str, signal: str) -> None:
    """Carry out a signal of a module for another task (Stewart 1994, section 8.2.1).

    Those for one task are carried out one after the other. One that repeats the last
    that waits, or is being carried out, is the same. No master has asked for them, so
    a refusal is an event of the task that sent it.
    """
    waiting = sender.orders.setdefault(name, deque())
    if waiting and waiting[-1] == signal:
        return
    if len(waiting) >= MOST_ORDERS:
        _refused(rtpu, sender, f"{signal} to {name}", f"{MOST_ORDERS} others wait")
        return
    waiting.append(signal)
    if len(waiting) == 1:
        chore = _carry_out(rtpu, sender, name, waiting)
        rtpu.later(chore, name=f"orders of {sender.name} to {name}")


async def _carry_out(rtpu: Rtpu, sender: Task, name: str, waiting: deque[str]) -> None:
    """Carry out the signals of a module for another task until none waits."""
    while waiting:
        try:
            await _obeyed(rtpu, sender.facts.subsystem, name, waiting[0])
        except PbonetError as error:
            _refused(rtpu, sender, f"{waiting[0]} to {name}", str(error))
        finally:
            waiting.popleft()
    sender.orders.pop(name, None)


async def _obeyed(rtpu: Rtpu, subsystem: str, name: str, signal: str) -> None:
    """Carry out a signal for a task of this machine, here or on the RTPU that has it.

    Raises:
        UnknownTaskError: No RTPU of the machine has the task.
        PbonetError: It was refused, or failed.
    """
    key = subsystem, name
    if key in rtpu.tasks:
        await control(rtpu, rtpu.tasks[key], signal, ORDER_TIME)
        return
    order = rtpu_messages.Order(subsystem, name, signal)
    found = await rtpu.ask_neighbours(order, ORDER_TIME + NEIGHBOUR_TIME)
    if found.answer is None and key in rtpu.tombs:
        rtpu.need(*key)  # says that it has died
    if found.answer is None:
        raise _on_no_rtpu(rtpu, name, found)
    if found.answer.error is not None:
        raise PbonetError.from_wire(found.answer.error)


def _on_no_rtpu(rtpu: Rtpu, name: str, found: Neighbours) -> UnknownTaskError:
    asked = ", ".join([rtpu.name, *found.asked])
    silent = f"; no answer from {', '.join(found.silent)}" if found.silent else ""
    which = "no RTPU of this machine" + " that answers" * bool(silent)
    return UnknownTaskError(
        f"{which} has task {name}",
        where=rtpu.name,
        got=f"asked: {asked}{silent}",
        remedy="a module reaches tasks of its machine; let the master signal others, "
        "or raise the flag with self.task.illegal",
    )


async def obey_neighbour(
    rtpu: Rtpu, order: rtpu_messages.Order
) -> rtpu_messages.Obeyed:
    """Carry out a signal that a module on another RTPU of the machine has sent."""
    task = rtpu.tasks.get((order.subsystem, order.task))
    if task is None:
        return rtpu_messages.Obeyed(here=False)
    try:
        if order.subsystem in rtpu.stopping:
            raise being_stopped(rtpu.name, order.subsystem)
        await control(rtpu, task, order.signal, ORDER_TIME)
    except PbonetError as error:
        return rtpu_messages.Obeyed(here=True, error=error.to_wire())
    return rtpu_messages.Obeyed(here=True)


def _refused(rtpu: Rtpu, sender: Task, order: str, why: str) -> None:
    """Report a signal of a module that was not carried out, unless there are many."""
    subsystem, task = sender.facts.subsystem, sender.name
    if not sender.budget.take(rtpu.now_ns()):
        rtpu.events.count("SIGNAL_FAILED", subsystem=subsystem, task=task)
        return
    rtpu.events.add(
        Severity.ERROR,
        "SIGNAL_FAILED",
        f"{order} was refused: {why}",
        subsystem=subsystem,
        task=task,
    )


async def _send(
    rtpu: Rtpu,
    task: Task,
    event: lifecycle.Event,
    make: Make,
    limit: float,
    *,
    extra: float,
) -> None:
    """Send a signal other than `kill`, and wait for the state it leads to."""
    await rtpu.successors.withdraw(task)
    if event is lifecycle.Event.ON:
        await rtpu.fallbacks.withdraw(task)
    lifecycle.rule(task.state, event, where=task.name)
    if event is lifecycle.Event.ON:
        rtpu.rank(task)
        rtpu.fallbacks.overtaken(task)
        await rtpu.fallbacks.ready(task)
    try:
        await task.command(event.value, make, limit, extra=extra)
    except PbonetError as error:
        note(rtpu, task, event, error)
        if event is lifecycle.Event.ON:
            await rtpu.fallbacks.spare(task)
        raise
    note(rtpu, task, event)


async def kill(rtpu: Rtpu, task: Task, limit: float, *, arg: str = "") -> list[str]:
    """Kill a task, by force if it does not go by itself; return warnings.

    Raises:
        PbonetError: Its `off` or its `kill` failed; it is gone nevertheless.
    """
    start = time.monotonic()
    failed: PbonetError | None = None
    task.stopping = True
    if rtpu.core.snapshot(task.facts.slot).hung:
        limit = min(limit, END_TIME)
    try:
        await task.command(
            "kill", lambda n: rtpu_messages.Signal(n, "kill", arg=arg), limit
        )
    except (NoAnswerError, StateError):
        pass  # it hangs in a method: force is what is left
    except TaskDiedError:
        if _crashed(rtpu, task):
            raise  # in its `off` or `kill`
        await task.end(END_TIME)  # before the `kill`; its end was not noticed yet
        rtpu.bury(task.facts.subsystem, task.name)
        return []
    except PbonetError as error:
        failed = error
    left = max(limit - (time.monotonic() - start), 0.0)
    said_good_bye = task.state is State.NOT_CREATED
    by_itself = await task.end(END_TIME if said_good_bye else left)
    note(rtpu, task, lifecycle.Event.KILL, failed)
    if failed is not None:
        raise failed
    if by_itself:
        return []
    text = f"task {task.name} did not end within {limit:g} s and was ended by force"
    rtpu.events.add(
        Severity.WARNING,
        "FORCED",
        text,
        subsystem=task.facts.subsystem,
        task=task.name,
    )
    return [text]


def _crashed(rtpu: Rtpu, task: Task) -> bool:
    """Return whether a task that has ended did so by itself."""
    return (task.facts.subsystem, task.name) in rtpu.tombs


def note(
    rtpu: Rtpu,
    task: Task,
    event: lifecycle.Event,
    error: PbonetError | None = None,
    *,
    ranked: bool = False,
) -> None:
    """Note what a signal has led to; `ranked`: ranking is the caller's work."""
    if event is lifecycle.Event.ON and task.state is State.ON:
        rtpu.turned_on += 1
        task.on_rank = rtpu.turned_on
        task.warnings = 0
        task.warning = ""
    rtpu.settle(task, ranked=ranked)
    rtpu.flags.evaluate()
    rtpu.events.add(
        Severity.ERROR if error else Severity.INFO,
        "SIGNAL_FAILED" if error else "STATE",
        event_codes.signal_text(event, task.state, str(error or "")),
        subsystem=task.facts.subsystem,
        task=task.name,
        cycle=rtpu.cycle_of(task),
        errnum=error.number if isinstance(error, MethodError) else 0,
        place=error.place if isinstance(error, MethodError) else "",
    )


async def stop(
    rtpu: Rtpu, subsystems: Sequence[str], limit: float, order: Sequence[str] = ()
) -> Stopped:
    """Turn tasks OFF in order, kill them, and say which had to be forced.

    Args:
        rtpu: The RTPU of the tasks.
        subsystems: The subsystems of the tasks.
        limit: Seconds in all; a task that hangs costs the others little of it.
        order: Tasks to turn off first; the others follow, last turned on first.
    """
    deadline = time.monotonic() + limit
    rtpu.stopping |= set(subsystems)
    rtpu.times_stopped.update(subsystems)
    for subsystem in subsystems:
        rtpu.fallbacks.dismiss_all(subsystem)
        rtpu.successors.dismiss_all(subsystem)
    try:
        tasks = [t for t in rtpu.tasks.values() if t.facts.subsystem in subsystems]
        tasks.sort(key=lambda t: _position(t, order))
        failed: dict[str, str] = {}
        until = deadline - limit * (1 - OFF_SHARE)
        turned_off = await _all_off(rtpu, tasks, until, failed)
        ends = await _all_ended(rtpu, tasks, deadline, failed)
        forced = [
            t.name for t, by_itself in zip(tasks, ends, strict=True) if not by_itself
        ]
        for subsystem in subsystems:
            rtpu.forget(subsystem)
    finally:
        rtpu.stopping -= set(subsystems)
    if tasks:
        rtpu.events.add(
            Severity.WARNING if forced or failed else Severity.INFO,
            "STOPPED",
            f"{len(tasks)} tasks ended"
            + (f", by force: {' '.join(forced)}" * bool(forced))
            + (f", with an error: {' '.join(failed)}" * bool(failed)),
            subsystem=subsystems[0] if len(subsystems) == 1 else "",
        )
    return Stopped(off=turned_off, killed=forced, failed=failed)


async def replaced(rtpu: Rtpu, tasks: Sequence[Task], limit: float) -> Stopped:
    """Turn off tasks in whose place others are; kill those that do not obey.

    Args:
        rtpu: The RTPU of the tasks.
        tasks: Those of them that are ON, or are being turned on, are turned off.
        limit: Seconds for each.
    """
    done = Stopped(off=[], killed=[])
    for task in tasks:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limit):
                await asyncio.gather(*(done.wait() for done in task.coming))
        if task.state is not State.ON and not task.coming:
            continue
        try:
            await control(rtpu, task, "off", limit)
            done.off.append(task.name)
        except PbonetError:
            if task.state is State.ON or task.coming:
                with contextlib.suppress(PbonetError):
                    await control(rtpu, task, "kill", limit)
                done.killed.append(task.name)
    return done


async def take_over(rtpu: Rtpu, order: rtpu_messages.TakeOver) -> None:
    """Turn a standby ON in the place of a task on another RTPU, and report that."""
    task = rtpu.tasks.get((order.subsystem, order.standby))
    if (
        task is None
        or order.subsystem in rtpu.stopping
        or not rtpu.fallbacks.stands_away(task)
    ):
        return
    rtpu.fallbacks.takes_over(task)
    failed: PbonetError | None = None
    try:
        await control(rtpu, task, "on", TAKEOVER_TIME)
    except PbonetError as error:
        failed = error
    rtpu.fallbacks.report_away(task, order.why, failed)


def _position(task: Task, order: Sequence[str]) -> tuple[int, int]:
    if task.name in order:
        return order.index(task.name), 0
    return len(order), -task.on_rank


async def _all_off(
    rtpu: Rtpu, tasks: Sequence[Task], deadline: float, failed: dict[str, str]
) -> list[str]:
    """Send off to those that are ON, one after the other; return those that obeyed."""
    running = [task for task in tasks if task.state is State.ON]
    obeyed: list[str] = []
    for i, task in enumerate(running):
        share = (deadline - time.monotonic()) / (len(running) - i)
        try:
            await control(rtpu, task, "off", max(share, LEAST))
            obeyed.append(task.name)
        except PbonetError as error:
            _note_failure(rtpu, failed, task, lifecycle.Event.OFF, error)
            if task.busy:  # else it is in ERROR, or has ended
                _calm(task)
    return obeyed


def _note_failure(
    rtpu: Rtpu,
    failed: dict[str, str],
    task: Task,
    event: lifecycle.Event,
    error: PbonetError,
) -> bool:
    """Note what went wrong at an end, the first thing for each task.

    Returns:
        Whether it is a failure. It is none if the task hangs, which ends it by force,
        or is in another state by now, or has ended because another order said so.
    """
    if isinstance(error, (NoAnswerError, StateError)):
        return False
    if isinstance(error, TaskDiedError) and not _crashed(rtpu, task):
        return False
    place = error.place if isinstance(error, MethodError) else ""
    text = f"{event}: {error.what}" + f" ({place})" * bool(place)
    failed.setdefault(task.name, text)
    return True


def _calm(task: Task) -> None:
    """Remove the real-time level of a task that hangs, so that others can obey."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(task.child.pid, os.SCHED_OTHER, os.sched_param(0))


async def _all_ended(
    rtpu: Rtpu, tasks: Sequence[Task], deadline: float, failed: dict[str, str]
) -> list[bool]:
    """Kill all at once; return which obeyed.

    Those that hang go by force after half of the time: one that spins at a real-time
    level keeps the others of its core from obeying.
    """
    half = (time.monotonic() + deadline) / 2
    return await asyncio.gather(
        *(_end(rtpu, task, half if task.busy else deadline, failed) for task in tasks)
    )


async def _end(rtpu: Rtpu, task: Task, deadline: float, failed: dict[str, str]) -> bool:
    """Kill one task until `deadline`, then by force; return whether it obeyed."""
    task.stopping = True
    left = deadline - time.monotonic()
    kill = lifecycle.Event.KILL
    try:
        await task.command(
            "kill", lambda n: rtpu_messages.Signal(n, "kill"), max(left, LEAST)
        )
    except PbonetError as error:
        if _note_failure(rtpu, failed, task, kill, error) and not task.gone.is_set():
            note(rtpu, task, kill, error)
    good_bye = task.state is State.NOT_CREATED and task.spawned.done()
    left = deadline - time.monotonic()
    return await task.end(max(left, END_TIME if good_bye else LEAST))
