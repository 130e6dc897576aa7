"""Frequencies and parameters of tasks, read and changed between two cycles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import Severity
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import ParamValue

from . import create_task

if TYPE_CHECKING:
    from .rtpu_state import Rtpu
    from .task_handle import Task

TIMEOUT = 1.9
"""Seconds: a little less than the master waits for an answer."""


async def get(task: Task, name: str | None) -> list[ParamValue]:
    """Return one parameter of a task, or all.

    Raises:
        PbonetError: What the task answered.
    """
    done = await task.command("get", lambda n: rtpu_messages.GetParam(n, name), TIMEOUT)
    return msgspec.convert(done.result, list[ParamValue])


async def set_(rtpu: Rtpu, task: Task, name: str, value: str) -> list[ParamValue]:
    """Change a parameter and return it as it is now.

    Raises:
        PbonetError: What the task answered; the old value remains.
    """
    done = await task.command(
        "set", lambda n: rtpu_messages.SetParam(n, name, value), TIMEOUT
    )
    rtpu.events.add(
        Severity.INFO,
        "SET",
        f"{name} = {value}",
        subsystem=task.facts.subsystem,
        task=task.name,
    )
    return msgspec.convert(done.result, list[ParamValue])


async def set_freq(rtpu: Rtpu, task: Task, hz: float) -> None:
    """Change a task's frequency, from its next release on.

    Raises:
        ParameterError: It is not possible.
        PbonetError: What the task answered.
    """
    wanted = create_task.check_freq(task.facts.rmod, hz)
    await task.command("freq", lambda n: rtpu_messages.SetFreq(n, wanted), TIMEOUT)
    rtpu.core.configure(task.facts.slot, **create_task.limits(task.facts.rmod, wanted))
    task.freq = wanted
    rtpu.rank()
    rtpu.events.add(
        Severity.INFO,
        "FREQ",
        f"{wanted:g} Hz",
        subsystem=task.facts.subsystem,
        task=task.name,
    )
