"""Makes the status of tasks and of the RTPU from shared memory; touches no task.

Stewart 1994, section 4.4.1, lists the fields; `docs/commands.md` says what each means.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pbonet.analysis.schedule import edge_ns
from pbonet.node.rt import KINDS
from pbonet.pbo import State
from pbonet.versions import LAYERS
from pbonet.xm.net import (
    RtpuStatus,
    SectionStatus,
    TaskProfile,
    TaskStatus,
    TbufStatus,
)

from .rtpu_snapshot import letter
from .task_signals import by_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.analysis.schedule import CoreStatus, Histograms, SlotStatus
    from pbonet.config import Rmod
    from pbonet.node.wire import Recorder
    from pbonet.xm.net import Gone

    from .rtpu_snapshot import TaskSnapshot

TICK = 1e-9
"""Resolution of the profile in seconds: the CPU clock counts nanoseconds."""
_NS = 1e-9


def task_status(
    rtpu: str, task: TaskSnapshot, slot: SlotStatus, signals: Sequence[int]
) -> TaskStatus:
    """Return everything that is known of a task.

    Args:
        rtpu: The RTPU's name.
        task: What the RTPU process knows of it.
        slot: The task's slot in the core table.
        signals: How often it has sent each signal.
    """
    cycles = slot.cycles - slot.on_cycles
    failed = slot.failed - slot.on_failed
    missed = slot.missed - slot.on_missed - failed
    released = cycles + missed + failed
    spent = (slot.cpu_total_ns - slot.on_cpu_ns) * _NS
    ptime = _profile_ns(task, slot, released) * _NS
    return TaskStatus(
        rmod=task.rmod,
        task=task.task,
        rtpu=rtpu,
        tid=task.tid,
        S=task.S,
        crit=slot.crit,
        crit_assumed=task.crit_assumed,
        priority=slot.priority,
        state=task.state,
        cycle=cycles,
        miss=missed,
        failed=failed,
        ref_f=task.ref_f,
        mez_f=cycles / ptime if ptime > 0 else 0.0,
        mez_t=ptime / released if released else 0.0,
        ptime=ptime,
        tot_c=spent,
        tick=TICK,
        min_c=slot.cpu_min_ns * _NS,
        max_c=slot.cpu_max_ns * _NS,
        last_c=slot.cpu_last_ns * _NS,
        first_c=slot.cpu_first_ns * _NS,
        now_c=slot.cpu_now_ns * _NS,
        warn=task.warn,
        warning=task.warning,
        error=task.error,
        jitter_max=slot.jitter_max_ns * _NS,
        jitter=list(slot.jitter),
        faults=slot.faults - slot.on_faults,
        retries=slot.torn,
        module=task.module,
        version=task.version,
        transfer_in=slot.copy_in_ns * _NS / slot.cycles if slot.cycles else 0.0,
        transfer_out=slot.copy_out_ns * _NS / slot.cycles if slot.cycles else 0.0,
        on_ns=slot.on_ns,
        now=slot.now_ns,
        ring=task.ring,
        lost=slot.ring_lost,
        rank=slot.rank,
        reserve=slot.maxc_ns * _NS,
        failures=dict(zip(KINDS, slot.failures, strict=True)),
        overruns=slot.overruns,
        aborted=slot.aborted,
        skipped=slot.skipped,
        handlers=slot.handlers,
        delivery_max=slot.delivery_max_ns * _NS,
        made_safe=slot.safe,
        made_safe_max=slot.safe_max_ns * _NS,
        held_off=slot.held_off,
        signals=by_name(signals, task.own),
        fallback_of=task.fallback_of,
        original_rtpu=task.original_rtpu,
        takeover=task.takeover,
        stands_by=task.stands_by,
        waits=task.waits,
        restart=task.restart,
        sections={
            one.name: SectionStatus(
                count=one.count,
                total=one.total_ns * _NS,
                min=one.min_ns * _NS,
                max=one.max_ns * _NS,
            )
            for one in slot.sections
        },
    )


def of_lost(rtpu: str, rmod: Rmod, lost: Gone) -> TaskStatus:
    """Return the status of a task that was lost with an RTPU process before."""
    return TaskStatus(
        rmod=rmod.name,
        task=lost.task,
        rtpu=rtpu,
        tid=0,
        S=letter(rmod),
        crit=0,
        state=State.NOT_CREATED,
        cycle=0,
        miss=0,
        ref_f=rmod.freq or 0.0,
        mez_f=0.0,
        mez_t=0.0,
        ptime=0.0,
        tot_c=0.0,
        tick=TICK,
        min_c=0.0,
        max_c=0.0,
        last_c=0.0,
        warn=0,
        error=lost.error,
        signals={"ERROR": 1},
    )


def _profile_ns(task: TaskSnapshot, slot: SlotStatus, released: int) -> int:
    """Return the time over which cycles were counted: since the task was turned on.

    The first release may come at once. So a task that has ended is given a period for
    each release, where that is at most one period more: one cycle is one in a period.
    """
    if slot.on_ns == 0:
        return 0
    if task.state == State.ON:
        return max(slot.now_ns - slot.on_ns, 0)
    lasted = max(slot.release_ns - slot.on_ns, 0)
    period = round(1e9 / task.ref_f) if task.ref_f > 0 else 0
    return max(lasted, min(released * period, lasted + period))


def task_profile(
    status: TaskStatus, slot: SlotStatus, histograms: Histograms
) -> TaskProfile:
    """Return a task's execution profile.

    The histogram runs since the task was spawned, the exact extremes since it was
    turned on, or they were restarted; the edges of its bins bound the earlier cycles.
    """
    bins = [index for index, count in enumerate(histograms.cpu) if count]
    least, most = slot.cpu_min_ns * _NS, slot.cpu_max_ns * _NS
    if bins and (slot.on_cycles or slot.restarted):
        least = min(least or math.inf, edge_ns(bins[0]) * _NS)
        most = max(most, edge_ns(bins[-1] + 1) * _NS)
    return TaskProfile(
        status=status,
        least=least,
        most=most,
        cpu=_counted(histograms.cpu),
        jitter=_counted(histograms.jitter),
        late=slot.late,
        failed=slot.failed,
    )


def _counted(counts: Sequence[int]) -> list[tuple[int, int]]:
    return [(index, count) for index, count in enumerate(counts) if count]


def rtpu_status(
    rtpu: str,
    scheduler: str,
    core: CoreStatus,
    cpu_ns: Callable[[], int],
    *,
    tasks: list[TaskStatus],
    spent_ns: int,
    illegal: list[str],
    events: dict[str, dict[str, int]],
    tbufs: list[TbufStatus],
    recorder: Recorder | None = None,
) -> RtpuStatus:
    """Return the status of the RTPU with that of the tasks asked for.

    Args:
        rtpu: Its name.
        scheduler: The algorithm in use.
        core: The dispatcher's entries in the core table.
        cpu_ns: Reads the dispatcher's CPU time, which is reported if there are tasks.
        tasks: The tasks asked for.
        spent_ns: CPU time of all its tasks since the dispatcher began.
        illegal: Causes for which the illegal-configuration flag is up.
        events: How often each event came, by task and code.
        tbufs: Links between subsystems that exist on the machine.
        recorder: The state of the subsystem's recorder.
    """
    now = max((task.now for task in tasks), default=0)
    since = now - core.since_ns if now and core.since_ns else 0
    return RtpuStatus(
        rtpu=rtpu,
        backend=core.backend,
        scheduler=scheduler,
        tasks=tasks,
        util=spent_ns / since if since > 0 else 0.0,
        dispatcher=cpu_ns() / since if since > 0 else 0.0,
        illegal=illegal,
        events=events,
        tbufs=tbufs,
        log=recorder.path if recorder else "",
        unlogged=recorder.lost if recorder else 0,
        stalls=core.stalls,
        stalled=core.stalled_ns * _NS,
        stall_age=None if core.stall_age_ns is None else core.stall_age_ns * _NS,
        versions=LAYERS,
    )
