"""The ``inline`` back end: the dispatcher's rules in virtual time, on one thread.

Releases, ranking and misses are the twin's own (`dispatch`); what a kernel
would do between two turns, running the most urgent task and preempting it, is worked
out here. Nothing depends on a clock, so a run can be repeated to the last digit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision, Kind, Mode
from pbonet.analysis.schedule.urgency import urgency

from .dispatch import Dispatcher
from .inputs import pack
from .slotstate import SlotState

if TYPE_CHECKING:
    from collections.abc import Callable


class Slice(Struct, frozen=True):
    """A stretch of time in which one task had the core."""

    task: str
    start_ns: int
    end_ns: int


class InlineTask(Struct):
    """A task on the virtual core, and its account."""

    name: str
    slot: int
    cycle: Callable[[int, float], int]
    finish: Callable[[int], None] | None
    word: int = 0
    cycles: int = 0
    late: int = 0
    cpu_ns: int = 0
    last_rel_ns: int = -1
    """Release of the last executed cycle; -1 before the first."""
    rel_ns: int = 0
    dl_ns: int = 0
    left_ns: int = -1
    """CPU time that the cycle under way still needs; -1 while there is none."""
    responses: list[int] = []
    """Nanoseconds from release to end, one per cycle."""


class Inline:
    """One virtual core.

    Args:
        start_ns: Where virtual time begins.
    """

    def __init__(self, start_ns: int = 0) -> None:
        self.now_ns = start_ns
        self.slices: list[Slice] = []
        self.trace: list[Decision] = []
        """Inputs and decisions of every turn, as the native dispatcher records them."""
        self.tasks: dict[str, InlineTask] = {}
        self._twin = Dispatcher()
        self._inputs: list[Decision] = []
        self._due = 0

    def add(
        self,
        name: str,
        cycle: Callable[[int, float], int],
        *,
        period_ns: int,
        deadline_ns: int = 0,
        crit: int = 5,
        priority: int = 0,
        finish: Callable[[int], None] | None = None,
    ) -> None:
        """Put a task on the core; it is OFF.

        Args:
            name: Unique on the core.
            cycle: Called with the instant at which the cycle begins and the seconds it
                advances by; returns the CPU nanoseconds that it takes.
            period_ns: Between releases.
            deadline_ns: Relative to the release; 0 means the period.
            crit: Criticality, 0 to 63.
            priority: User priority, 0 to 65535.
            finish: Called with the instant at which the cycle ends; this is where
                outputs are committed.

        Raises:
            ValueError: The name is taken, or a value is out of its range.
        """
        if name in self.tasks:
            msg = f"task {name} is on the core already"
            raise ValueError(msg)
        if period_ns <= 0:
            msg = f"period {period_ns} ns is not above zero"
            raise ValueError(msg)
        urgency(crit, max(deadline_ns, 0), priority)
        slot = len(self.tasks)
        self.tasks[name] = InlineTask(name, slot, cycle, finish, responses=[])
        arg = pack(crit, priority, Kind.PERIODIC)
        self._inputs += [
            Decision(Event.LIFE, slot, 1, 0, 0),
            Decision(Event.CONFIG, slot, arg, period_ns, deadline_ns),
        ]

    def on(self, name: str) -> None:
        """Arm a task: its first release is the next one on the grid."""
        task = self.tasks[name]
        if task.word & 3 == Mode.OFF:
            task.word = (task.word & ~3) + 4 | Mode.ON
            task.last_rel_ns, task.left_ns = -1, -1
            self._inputs.append(Decision(Event.MODE, task.slot, task.word, 0, 0))

    def off(self, name: str) -> None:
        """Disarm a task; a cycle under way is dropped."""
        task = self.tasks[name]
        if task.word & 3 != Mode.OFF:
            task.word = task.word & ~3 | Mode.OFF
            task.left_ns = -1
            self._inputs.append(Decision(Event.MODE, task.slot, task.word, 0, 0))

    def missed(self, name: str) -> int:
        """Return how many releases of a task had no cycle of their own."""
        return self._state(self.tasks[name]).missed

    def run_until(self, until_ns: int) -> None:
        """Let virtual time pass up to `until_ns`, events at that instant included."""
        while True:
            self._turn()
            while (running := self._top()) is not None:
                if self._compute(running, until_ns):
                    break
            if not self._due or self._due > until_ns:
                break
            self.now_ns = max(self.now_ns, self._due)
        self.now_ns = max(self.now_ns, until_ns)

    def _state(self, task: InlineTask) -> SlotState:
        return self._twin.slots[task.slot]

    def _turn(self) -> None:
        inputs = sorted(self._inputs, key=lambda record: record.slot)
        self._inputs = []
        decisions, self._due = self._twin.turn(self.now_ns, inputs)
        self.trace.append(Decision(Event.TURN, 0, 0, self.now_ns, self._due))
        self.trace += inputs + decisions

    def _top(self) -> InlineTask | None:
        """Return the task that the kernel would run now: the highest level."""
        best: InlineTask | None = None
        level = 0
        done = {record.slot for record in self._inputs if record.kind == Event.DONE}
        for task in self.tasks.values():
            state = self._twin.slots.get(task.slot)
            if state is None or not state.granted or task.slot in done:
                continue
            if state.level > level:
                best, level = task, state.level
        return best

    def _compute(self, task: InlineTask, until_ns: int) -> bool:
        """Run the task until its cycle ends or the next event is due (True)."""
        if task.left_ns < 0:
            self._begin(task)
        limit = min(self._due or until_ns, until_ns)
        start, end = (
            self.now_ns,
            min(self.now_ns + task.left_ns, max(limit, self.now_ns)),
        )
        self.now_ns = end
        task.left_ns -= end - start
        task.cpu_ns += end - start
        if end > start:
            self._slice(task.name, start, end)
        if task.left_ns > 0:
            return True
        self._end(task)
        return False

    def _begin(self, task: InlineTask) -> None:
        state = self._state(task)
        task.rel_ns, task.dl_ns = state.rel_ns, state.dl_ns
        step = state.period if task.last_rel_ns < 0 else task.rel_ns - task.last_rel_ns
        self._inputs.append(Decision(Event.BEGUN, task.slot, 0, 0, 0))
        task.left_ns = max(task.cycle(self.now_ns, step * 1e-9), 0)

    def _end(self, task: InlineTask) -> None:
        if task.finish is not None:
            task.finish(self.now_ns)
        task.left_ns = -1
        task.cycles += 1
        task.late += self.now_ns > task.dl_ns
        task.last_rel_ns = task.rel_ns
        task.responses.append(self.now_ns - task.rel_ns)
        self._inputs = [
            record
            for record in self._inputs
            if (record.slot, record.kind) != (task.slot, Event.BEGUN)
        ]
        self._inputs.append(Decision(Event.DONE, task.slot, 0, 0, 0))

    def _slice(self, name: str, start: int, end: int) -> None:
        last = self.slices[-1] if self.slices else None
        if last is not None and last.task == name and last.end_ns == start:
            start = last.start_ns
            self.slices.pop()
        self.slices.append(Slice(name, start, end))
