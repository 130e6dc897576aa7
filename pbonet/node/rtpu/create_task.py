"""Creates tasks (Stewart 1994, section 4.5.2)."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import msgspec
from msgspec import structs

from pbonet.analysis.schedule import Kind
from pbonet.config import RtpuEntry, TaskType, parse_rmod
from pbonet.errors import (
    NoAnswerError,
    ParameterError,
    PbonetError,
    Severity,
    StateError,
)
from pbonet.node import rt
from pbonet.node.wire import rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import MOST_EXTRA, run_folder

from . import status
from .task_handle import Facts, Task

if TYPE_CHECKING:
    from pbonet.config import Rmod
    from pbonet.xm.net import Gone, Spawn, TaskStatus

    from .rtpu_state import Rtpu
    from .tables import Opened

KINDS = {
    TaskType.PERIODIC: Kind.PERIODIC,
    TaskType.SYNCHRONOUS: Kind.SYNCHRONOUS,
    TaskType.DEFERRABLE: Kind.DEFERRABLE,
    TaskType.SPORADIC: Kind.SPORADIC,
    TaskType.BACKGROUND: Kind.BACKGROUND,
}
SILENCE = 2
"""Periods after which a device that times a task counts as silent."""
FASTEST = 1e9 / rt.MIN_PERIOD_NS
"""Hz."""
HIGHEST_CRIT = 62
"""0 and 63 are reserved (section 4.5.1)."""
HIGHEST_PRIORITY = 65535


class Plan(NamedTuple):
    """The plan of a task."""

    rmod: Rmod
    freq: float
    slot: int
    opened: Opened


async def spawn(rtpu: Rtpu, request: Spawn) -> Task:
    """Create a task and wait until it is OFF; nothing is left of one that fails.

    Raises:
        ConfigError: The RMOD is wrong.
        PbonetError: What went wrong, in the task's own words where it reported any.
    """
    key = (request.subsystem, request.task)
    _check_free(rtpu, key)
    opened = rtpu.tables.need_file(request.subsystem)
    rmod = with_effective(parse_rmod(request.rmod, request.rmod_name), request.effc)
    freq = check_freq(rmod, request.freq)
    check_rank(request.crit, request.priority, request.task)
    slot = rtpu.core.alloc(rtpu.slot_owner, "/".join(key))
    stops = rtpu.times_stopped[request.subsystem]
    try:
        task = await _fork(rtpu, request, Plan(rmod, freq, slot, opened))
    except BaseException:
        rtpu.core.free(slot)
        raise
    if rtpu.times_stopped[request.subsystem] != stops:
        await task.end(0.0)
        raise StateError(
            f"subsystem {request.subsystem} was stopped while {request.task} was "
            "being created",
            where=f"{rtpu.name}/{request.task}",
            remedy="spawn it again",
        )
    rtpu.tombs.pop(key, None)
    await _wait_until_off(rtpu, task, request.timeout)
    if not request.missed:
        rtpu.flags.down(*key)
    return task


def gone(rtpu: Rtpu, request: Gone) -> TaskStatus:
    """Note a task that was lost with an RTPU process before, as one that has died.

    Raises:
        StateError: There is a task of that name.
        ConfigError: The RMOD is wrong.
    """
    key = (request.subsystem, request.task)
    _check_free(rtpu, key)
    rmod = parse_rmod(request.rmod, request.rmod_name)
    last = rtpu.tombs[key] = status.of_lost(rtpu.name, rmod, request)
    outputs = [rmod.svar_name(port) for port in rmod.outvar]
    if request.was_on and outputs:
        cause = f"{request.task} was lost with its RTPU process"
        rtpu.flags.up(*key, cause, outputs)
    rtpu.notify_changed()
    return last


def with_effective(rmod: Rmod, seconds: float | None) -> Rmod:
    """Return a soft task's E for its rank: as measured where the RMOD has none."""
    if not rmod.softness or rmod.effc is not None:
        return rmod
    return structs.replace(rmod, effc=seconds)


def _check_free(rtpu: Rtpu, key: tuple[str, str]) -> None:
    subsystem, name = key
    run_folder.check_name("a subsystem", subsystem)
    run_folder.check_name("a task", name)
    if key in rtpu.tasks:
        raise StateError(
            f"subsystem {subsystem} has a task {name} already",
            where=rtpu.name,
            got=f"state {rtpu.tasks[key].state}",
            remedy="`kill` it first",
        )


def check_freq(rmod: Rmod, freq: float | None) -> float:
    """Return the frequency that a task of `rmod` gets, in Hz; 0 where it has none.

    Raises:
        ParameterError: The frequency is not possible.
    """
    wanted = rmod.freq if freq is None else freq
    if wanted is None:
        return 0.0
    if not 0.0 < wanted <= FASTEST:
        raise ParameterError(
            "no task can run at this frequency",
            where=rmod.name,
            expected=f"above 0 and at most {FASTEST:g} Hz",
            got=f"{wanted:g} Hz",
            remedy="correct FREQ in the .rmod file, or name a frequency within this",
        )
    return wanted


def check_rank(crit: int | None, priority: int, name: str) -> None:
    """Refuse a criticality or priority that the dispatcher does not have.

    Raises:
        ParameterError: It is out of its range.
    """
    if crit is not None and not 1 <= crit <= HIGHEST_CRIT:
        raise ParameterError(
            "there is no such criticality",
            where=name,
            expected=f"1 to {HIGHEST_CRIT}",
            got=str(crit),
            remedy="name one within this, or leave it to the scheduler",
        )
    if not 0 <= priority <= HIGHEST_PRIORITY:
        raise ParameterError(
            "there is no such user priority",
            where=name,
            expected=f"0 to {HIGHEST_PRIORITY}",
            got=str(priority),
            remedy="name one within this, or leave it to the data flow",
        )


class Limits(TypedDict, total=False):
    """Limits that the dispatcher watches, in nanoseconds."""

    period_ns: int
    deadline_ns: int
    minc_ns: int
    maxc_ns: int


def hang_ns(rtpu: Rtpu, subsystem: str) -> int:
    """Return the CPU time after which a cycle beyond its period hangs."""
    entry = rtpu.claims.get(subsystem) or RtpuEntry(name=rtpu.name)
    return _ns(entry.hangtime)


def limits(rmod: Rmod, freq: float) -> Limits:
    """Return the limits the dispatcher watches for a task that runs at `freq` Hz.

    The reserve is a server's capacity, the E of a soft task, or MAXC. A device that
    times a task is expected at the task's frequency.
    """
    found = Limits(minc_ns=_ns(rmod.minc), maxc_ns=_ns(rmod.maxc))
    if rmod.softness and rmod.effc is not None:
        found["maxc_ns"] = _ns(rmod.effc)
    if rmod.capacity is not None:
        found["maxc_ns"] = _ns(rmod.capacity)
    if freq:
        found["period_ns"] = _ns(1.0 / freq)
        if rmod.tasktype is TaskType.SYNCHRONOUS:
            found["deadline_ns"] = SILENCE * found["period_ns"]
    return found


def _ns(seconds: float | None) -> int:
    return round((seconds or 0.0) * 1e9)


async def _fork(rtpu: Rtpu, request: Spawn, plan: Plan) -> Task:
    rmod, freq, slot, opened = plan
    key = (request.subsystem, request.task)
    ring = f"{rtpu.config.domain}.{request.subsystem}.{request.task}"
    rtpu.core.configure(
        slot,
        kind=KINDS[rmod.tasktype],
        handler=rmod.handler or 0,
        hang_ns=hang_ns(rtpu, request.subsystem),
        **limits(rmod, freq),
    )
    spec = rtpu_messages.TaskSpec(
        domain=rtpu.config.domain,
        rtpu=rtpu.name,
        subsystem=request.subsystem,
        task=request.task,
        core=rtpu.config.core,
        slot=slot,
        table=opened.table.name,
        layout=opened.table.layout,
        rmod=request.rmod,
        rmod_name=request.rmod_name,
        freq=freq,
        ring=ring,
        libraries=rtpu.config.libraries,
        replaces=request.replaces,
        devices=rtpu.config.devices,
        spps=rtpu.config.spps,
    )
    rtpu.rings.add(ring)  # first: the task may make it before the fork is answered
    rtpu.save()
    try:
        child = await rtpu.spawner.fork("task", request.task, spec)
    except PbonetError:
        rtpu.rings.discard(ring)
        rtpu.save()  # another RTPU may have a task of that name next
        raise
    facts = Facts(
        subsystem=request.subsystem,
        name=request.task,
        rmod=rmod,
        text=request.rmod,
        slot=slot,
        ring=ring,
        restart=request.restart,
    )
    task = Task(
        facts,
        child,
        wake=lambda last: rtpu.core.request(slot, last=last),
        tell=rtpu.take_notice,
        changed=rtpu.notify_changed,
        ended=rtpu.ended,
    )
    task.freq = freq
    task.stopping = True  # until it is OFF, its end is the spawn's answer, no event
    rtpu.core.configure(slot, pid=child.pid)
    rtpu.signals.apply(rtpu.core, task)  # as far as names are known before `init`
    rtpu.tasks[key] = task
    rtpu.spawned[key] = (request.crit, request.priority)
    rtpu.rank()
    rtpu.save()
    return task


async def _wait_until_off(rtpu: Rtpu, task: Task, limit: float) -> None:
    """Wait for the end of `init`; a task that fails, dies or hangs in it is ended."""
    try:
        extra = MOST_EXTRA * limit
        done = await task.wait_for(task.spawned, "init", limit, extra=extra)
    except PbonetError as error:
        if isinstance(error, NoAnswerError):
            error.what = error.what.replace(
                "the task did not finish 'init'", "`init` did not return"
            )
            error.remedy = "`timeout` of the spawn gives it longer"
            error.debug = await task.where()
            task.child.send_signal(signal.SIGKILL)
        await task.end(1.0)
        rtpu.events.add(
            Severity.ERROR,
            "SPAWN_FAILED",
            _with_trace(error),
            subsystem=task.facts.subsystem,
            task=task.name,
        )
        raise
    task.ready = msgspec.convert(done.result, rtpu_messages.TaskReady)
    rtpu.core.configure(
        task.facts.slot, tells=task.ready.tells, safe_at=task.facts.rmod.safe_at
    )
    rtpu.signals.apply(rtpu.core, task)
    task.stopping = False
    rtpu.watch_life(task)
    rtpu.events.add(
        Severity.INFO,
        "SPAWNED",
        f"process {task.child.pid}, module {task.ready.module} {task.ready.version}, "
        f"state {State.OFF}",
        subsystem=task.facts.subsystem,
        task=task.name,
    )


def _with_trace(error: PbonetError) -> str:
    return f"{error}\n{error.debug}" if error.debug else str(error)
