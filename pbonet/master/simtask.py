"""One task of a simulation, and the releases of one simulated RTPU."""

from __future__ import annotations

from msgspec import Struct

from pbonet.master.picture import Member
from pbonet.master.recording import TaskRecord
from pbonet.master.simtable import MemoryCopies
from pbonet.node.executor import Executor
from pbonet.pbo import BoundedOutbox, Counted
from pbonet.sched.dispatch import Dispatcher
from pbonet.sched.events import Event, pack
from pbonet.sched.records import Decision, Kind, Mode


class SimTask(Struct, kw_only=True, eq=False):
    """One task of a simulation."""

    member: Member
    executor: Executor
    copies: MemoryCopies
    source: Counted
    outbox: BoundedOutbox
    slot: int
    record: TaskRecord
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

    @property
    def name(self) -> str:
        """The task's name."""
        return self.member.name

    @property
    def period_ns(self) -> int:
        """Nanoseconds from release to release."""
        return round(1e9 / self.member.freq)


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

    def mode(self, task: SimTask, *, on: bool) -> bool:
        """Arm or disarm a task; False when it was so before."""
        armed = bool(task.arms % 2)
        if armed == on:
            return False
        task.arms += 1
        word = (Mode.ON if on else Mode.OFF) | (task.arms & 0x7FFF) << 2
        self._tell(Event.MODE, task, word)
        self.due_ns = self.due_ns or 1  # as soon as time goes on
        return True

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

    def _tell(self, event: Event, task: SimTask, arg: int = 0, a: int = 0) -> None:
        self._inputs.append(Decision(int(event), task.slot, arg, a, 0))
