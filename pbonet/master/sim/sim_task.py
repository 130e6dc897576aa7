"""One task of a simulation, and the releases of one simulated RTPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.schedule import (
    After,
    Decision,
    Dispatcher,
    Event,
    Kind,
    Mode,
    pack,
)
from pbonet.config import Rmod, TaskType
from pbonet.errors import NodeError
from pbonet.master.configuration import Member
from pbonet.node.task import placed
from pbonet.pbo import BoundedOutbox, Signal, State
from pbonet.xm.net import messages as m

from .sim_journal import SimExecutor, SimTime
from .sim_recording import TaskRecord
from .sim_table import MemoryCopies

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.config import RtpuEntry
    from pbonet.pbo import Notice

_BITS = 64
_WORD = (1 << _BITS) - 1
"""Slots are named by bits, in two words."""


class SimTask(Struct, kw_only=True, eq=False):
    """One task of a simulation."""

    member: Member
    executor: SimExecutor
    copies: MemoryCopies
    source: SimTime
    outbox: BoundedOutbox
    slot: int
    record: TaskRecord | None
    """Its cycles in memory; None where they go into a log."""
    crit: int = 0
    priority: int = 0
    arms: int = 0
    on_ns: int = 0
    """When it was last turned on; 0 for never."""
    last_ns: int = 0
    """The release of the last executed cycle; 0 when there was none since ON."""
    warnings: int = 0
    """Since it was last turned on."""
    warning: str = ""
    """The first of them."""
    tid: int = 0
    """As the number of a process: another one for each task, 0 where nobody asks."""
    stands_by: str = ""
    """The task that this one is the fallback of, while it stands by for it."""

    @property
    def name(self) -> str:
        """The task's name."""
        return self.member.name

    @property
    def period_ns(self) -> int:
        """Nanoseconds from release to release; 0 for background work."""
        return round(1e9 / self.member.freq) if self.member.freq else 0

    @property
    def error(self) -> str:
        """What failed last, with the line of the module behind it."""
        failure = self.executor.failure
        return placed(self.executor.task.errmsg, failure.place if failure else "")

    def said(self, notice: Notice) -> str:
        """Return what a module has said, as a line."""
        fell = notice.bits & Signal.ERROR
        text = self.error if fell else placed(notice.text, notice.place)
        return f"{self.name}: {text}"


class Turns:
    """The dispatcher of one RTPU, by its own rules, and the tasks in its slots."""

    def __init__(self) -> None:
        self.tasks: list[SimTask] = []
        self.due_ns = 0
        """When it wants its next turn; 0 for never."""
        self._rules = Dispatcher(park=True)
        self._inputs: list[Decision] = []

    def add(self, task: SimTask) -> None:
        """Give a task the next slot."""
        self.tasks.append(task)
        self._tell(Event.LIFE, task, 1)
        self.configure(task)

    def configure(self, task: SimTask) -> None:
        """Tell the dispatcher a task's period and rank."""
        arg = pack(task.crit, task.priority, int(Kind.PERIODIC))
        self._tell(Event.CONFIG, task, arg, task.period_ns)

    def mode(self, task: SimTask, *, on: bool, fell: bool = False) -> bool:
        """Arm or disarm a task, which fell by ERROR; False when it was so before."""
        armed = bool(task.arms % 2)
        if armed == on:
            return False
        self._arm(task, Mode.ON if on else Mode.OFF, 1, fell=fell)
        if fell:
            self.due_ns = 1  # who stands by for it is engaged at this instant
        return True

    def stand_by(self, task: SimTask, original: SimTask) -> None:
        """Have a task that is OFF wait until another one falls."""
        mask = 1 << original.slot
        kind = int(After.FALLBACK)
        self._tell(Event.AFTER, task, kind, mask & _WORD, mask >> _BITS)
        self._arm(task, Mode.STANDS, 2)

    def rest(self, task: SimTask) -> None:
        """Have it wait no longer."""
        self._tell(Event.AFTER, task, int(After.ALONE))
        self._arm(task, Mode.OFF, 2)

    def _arm(self, task: SimTask, mode: Mode, more: int, *, fell: bool = False) -> None:
        """Tell the dispatcher a mode; an odd number of armings is ON."""
        task.arms += more
        word = mode | (task.arms & 0x7FFF) << 2
        self._tell(Event.MODE, task, word, int(fell))
        self.due_ns = self.due_ns or 1  # as soon as time goes on

    def next(self, now_ns: int) -> SimTask | None:
        """Take a turn; return the task that is let run, None when nobody is."""
        inputs, self._inputs = self._inputs, []
        decisions, self.due_ns = self._rules.turn(now_ns, inputs)
        for decision in decisions:
            if decision.kind == Event.WAKE:
                return self.tasks[decision.slot]
        return None

    def done(self, task: SimTask) -> None:
        """Tell the dispatcher that a granted cycle has ended."""
        self._tell(Event.DONE, task)

    def _tell(
        self, event: Event, task: SimTask, arg: int = 0, a: int = 0, b: int = 0
    ) -> None:
        self._inputs.append(Decision(int(event), task.slot, arg, a, b))


def status_of(task: SimTask, now_ns: int) -> m.TaskStatus:
    """Return the status of a task; CPU times are not simulated."""
    state = task.executor.state
    until_ns = now_ns if state is State.ON else max(task.last_ns, task.on_ns)
    seconds = (until_ns - task.on_ns) * 1e-9
    cycles = task.source.cyclecount
    info = task.member.info
    return m.TaskStatus(
        rmod=task.name,
        task=task.name,
        rtpu=task.member.rtpu,
        tid=task.tid,
        S="P" if task.member.rmod.tasktype is TaskType.PERIODIC else "Y",
        crit=task.crit,
        rank=task.crit,
        priority=task.priority,
        state=state,
        cycle=cycles,
        miss=0,
        ref_f=task.member.freq,
        mez_f=cycles / seconds if seconds else 0.0,
        mez_t=seconds / cycles if cycles else 0.0,
        ptime=seconds,
        on_ns=task.on_ns,
        tot_c=0.0,
        tick=1e-9,
        min_c=0.0,
        max_c=0.0,
        last_c=0.0,
        warn=task.warnings,
        warning=task.warning,
        error=task.error if state is State.ERROR else "",
        module=info.name if info else "",
        version=info.version if info else "",
        now=now_ns,
        fallback_of=task.member.fallback_of,
        stands_by=bool(task.stands_by),
    )


def must_be_simulated(
    record: Rmod, freq: float | None, kinds: tuple[TaskType, ...], where: str
) -> None:
    """Refuse a task that the clock alone does not drive.

    Raises:
        NodeError: It is one.
    """
    timed = freq or record.tasktype is TaskType.BACKGROUND
    if record.tasktype not in kinds or not timed:
        raise NodeError(
            f"a {record.tasktype} task cannot be simulated",
            where=where,
            expected=f"{' or '.join(kinds)}, with FREQ or PERIOD",
            got=f"TASKTYPE {record.tasktype}",
            remedy="run it in real time",
        )


def rtpu_status(
    entry: RtpuEntry, tasks: Iterable[SimTask], illegal: list[str], now_ns: int
) -> m.RtpuStatus:
    """Return the status of an RTPU and of those of the tasks that it runs."""
    return m.RtpuStatus(
        rtpu=entry.name,
        backend="inline",
        scheduler=entry.scheduler,
        tasks=[
            status_of(task, now_ns) for task in tasks if task.member.rtpu == entry.name
        ],
        illegal=illegal,
    )


def unwritten(tasks: Iterable[SimTask]) -> set[str]:
    """Return what raises the illegal-configuration flag: equation 2 of 3.3.1."""
    on = [task for task in tasks if task.executor.state is State.ON]
    written = {name for task in on for name in task.member.task.outputs}
    return {
        f"{task.name} reads {name}, which nobody writes"
        for task in on
        for name in task.member.task.inputs
        if name not in written
    }
