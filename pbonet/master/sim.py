"""A job in virtual time: one thread, no devices, the same result every time.

The modules are loaded, bound and run as in a task process, by the same executor. Copies
go to a table in plain memory, and releases are granted by the rules of the dispatcher
(`pbonet.sched.dispatch`), one for each RTPU. A cycle takes no virtual time: at one
instant the RTPUs have their turn in the order of the ``.sbs`` file, and on each the
more urgent task first. So a simulation shows what the control laws do; how long they
take, and what a late cycle does, only a run in real time shows.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet import verify
from pbonet.config.library import Library
from pbonet.config.model import TaskType
from pbonet.errors import (
    NodeError,
    PbonetError,
    StateError,
    UnknownTaskError,
    did_you_mean,
)
from pbonet.io.policy import no_devices
from pbonet.master.files import Files
from pbonet.master.picture import Member
from pbonet.master.recording import STABLE, Recording, TaskRecord
from pbonet.master.simtable import MemoryCopies, MemoryTable
from pbonet.node.executor import Executor
from pbonet.node.taskports import check_ports
from pbonet.pbo import (
    BoundedOutbox,
    Counted,
    Signal,
    State,
    TaskContext,
    bind,
    decode_params,
)
from pbonet.sched.criticality import PLANNED
from pbonet.sched.dispatch import Dispatcher
from pbonet.sched.events import Event, pack
from pbonet.sched.records import Decision, Kind, Mode
from pbonet.xm import messages as m

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pbonet.config.model import JobFile, JobTask
    from pbonet.pbo import Notice

REASON = "this is a simulation"
BEGIN_NS = 1_000_000_000
"""The virtual clock's first instant."""
_SIMULATED = {TaskType.PERIODIC, TaskType.SYNCHRONOUS}


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


class Simulation:
    """One job, from its assembly to its end.

    Args:
        path: The ``.job`` file.
        folders: Of module libraries, beside those of pbonet and installed packages.

    Attributes:
        recording: Every cycle so far.
        events: What went wrong or was said so far, one text each.

    Raises:
        ConfigError: A file is missing or wrong.
    """

    def __init__(self, path: str | Path, folders: Iterable[str | Path] = ()) -> None:
        self._library = Library(folders)
        self._files = Files(path, self._library)
        self.job: JobFile = self._files.read_job()
        self.table = MemoryTable(self._files.table.variables)
        self.now_ns = BEGIN_NS
        self.recording = Recording({
            "job": self.job.name,
            "file": self.job.file,
            "mode": "simulation",
        })
        self.events: list[str] = []
        self._tasks: dict[str, SimTask] = {}
        self._turns = {rtpu.name: _Turns() for rtpu in self._files.sbs.rtpus}

    # -- the job ----------------------------------------------------------------------

    def start(self) -> None:
        """Verify the job, spawn its tasks and turn them on.

        Raises:
            VerificationError: The configuration would be illegal.
            PbonetError: A module is missing, or its `init` or `on` failed; everything
                is undone.
        """
        members = {m.name: m for m in map(self._member, self.job.tasks)}
        tasks = [member.task for member in members.values()]
        verdict = self._judged(tasks, producers=False)
        if verdict.problems:
            verdict = self._judged(tasks, producers=True)
        verdict.check()
        self.events += map(verify.as_text, verdict.warnings)
        with no_devices(REASON):
            try:
                for name in verify.spawn_order(tasks):
                    self._spawn(members[name])
                self._rank(verify.user_priorities(tasks))
                for name in verify.on_order(tasks):
                    self.signal(name, "on")
            except BaseException:
                self._end()
                raise

    def advance(self, seconds: float) -> None:
        """Let virtual time pass, as fast as the modules can be run."""
        end_ns = self.now_ns + round(seconds * 1e9)
        with no_devices(REASON):
            while True:
                due = [t.due_ns for t in self._turns.values() if t.due_ns]
                if not due or min(due) > end_ns:
                    break
                self.now_ns = max(self.now_ns, min(due))
                for turns in self._turns.values():
                    if 0 < turns.due_ns <= self.now_ns:
                        self._turn(turns)
        self.now_ns = end_ns

    def signal(self, task: str, name: str) -> State:
        """Send ``on``, ``off``, ``kill``, ``clear`` or ``reinit`` to a task.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: The signal is not valid in its state.
            PbonetError: A method of the module failed.
        """
        found = self.task(task)
        with no_devices(REASON):
            try:
                return found.executor.signal(name)
            finally:
                self._after(found, found.outbox.drain())

    def set(self, task: str, name: str, value: str) -> object:
        """Change a parameter of a task; `value` is what a LOCAL line would have."""
        return self.task(task).executor.set(name, tuple(value.split()))

    def stop(self) -> None:
        """Turn everything off in the job's order, and kill it."""
        with no_devices(REASON):
            self._end()

    def run(self, seconds: float) -> Recording:
        """Start, let virtual time pass, stop; return every cycle of it.

        Raises:
            PbonetError: As for `start`.
        """
        self.start()
        try:
            self.advance(seconds)
        finally:
            self.stop()
        return self.recording

    # -- what can be looked at --------------------------------------------------------

    def task(self, name: str) -> SimTask:
        """Return a task.

        Raises:
            UnknownTaskError: There is none of that name.
        """
        if name not in self._tasks:
            raise UnknownTaskError(
                f"the simulation has no task {name}",
                expected=" or ".join(self._tasks) or "a job that was started",
                remedy=did_you_mean(name, self._tasks) or "name a task of the job",
            )
        return self._tasks[name]

    def states(self) -> dict[str, State]:
        """Return the state of every task."""
        return {name: task.executor.state for name, task in self._tasks.items()}

    def status(self) -> list[m.RtpuStatus]:
        """Return what `pbonet status` would show; CPU times are not simulated."""
        return [
            m.RtpuStatus(
                rtpu=entry.name,
                backend="inline",
                scheduler=entry.scheduler,
                tasks=[
                    self._status(task)
                    for task in self._tasks.values()
                    if task.member.rtpu == entry.name
                ],
                illegal=sorted(self.table.causes),
            )
            for entry in self._files.sbs.rtpus
        ]

    def _status(self, task: SimTask) -> m.TaskStatus:
        state = task.executor.state
        until_ns = self.now_ns if state is State.ON else max(task.last_ns, task.on_ns)
        seconds = (until_ns - task.on_ns) * 1e-9
        cycles = task.source.cyclecount
        info = task.member.info
        return m.TaskStatus(
            rmod=task.name,
            task=task.name,
            rtpu=task.member.rtpu,
            tid=0,
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
            error=task.executor.task.errmsg if state is State.ERROR else "",
            module=info.name if info else "",
            version=info.version if info else "",
            now=self.now_ns,
        )

    # -- assembling -------------------------------------------------------------------

    def _member(self, wanted: JobTask) -> Member:
        source = self._files.rmod(wanted.rmod)
        record = source.record
        rtpu = wanted.rtpu or record.rtpu or self._files.sbs.rtpus[0].name
        freq = wanted.freq or record.freq
        if record.tasktype not in _SIMULATED or not freq:
            raise NodeError(
                f"a {record.tasktype} task cannot be simulated",
                where=str(wanted.place or self.job.file),
                expected="periodic or synchronous, with FREQ or PERIOD",
                got=f"TASKTYPE {record.tasktype}",
                remedy="run the job without --sim",
            )
        info = self._library.load(record.module).info
        return Member(source=source, rtpu=rtpu, freq=freq, info=info, told=wanted.told)

    def _judged(self, tasks: list[verify.Task], *, producers: bool) -> verify.Verdict:
        """Judge the job; with `producers`, remedies can name RMODs of the library."""
        empty = verify.Configuration(
            svar=self._files.table,
            rtpus=self._files.sbs.rtpus,
            producers=self._files.producers() if producers else {},
            limit=PLANNED,
        )
        return verify.judge(empty, verify.job(tasks))

    def _spawn(self, member: Member) -> None:
        rmod = member.rmod
        loaded = self._library.load(rmod.module)
        check_ports(rmod, loaded.info)
        params = decode_params(loaded.cls, rmod.local, where=rmod.file)
        copies = MemoryCopies(self.table, rmod)
        source = Counted(lambda: self.now_ns)
        outbox = BoundedOutbox()
        context = TaskContext(
            member.name, freq=member.freq, source=source, outbox=outbox
        )
        arrays = {
            port.attr: copies.array(rmod.svar_name(port.name))
            for port in loaded.info.ports
        }
        instance = bind(loaded.cls, params, arrays, context)
        executor = Executor(
            instance,
            copies,
            illegal=(lambda: bool(self.table.causes)) if rmod.critical else None,
        )
        turns = self._turns[member.rtpu]
        task = SimTask(
            member=member,
            executor=executor,
            copies=copies,
            source=source,
            outbox=outbox,
            slot=len(turns.tasks),
            record=self.recording.task(
                member.name, self.table.variables, copies.out_vars
            ),
        )
        self._tasks[member.name] = task
        turns.add(task)
        executor.spawn()
        self._after(task, outbox.drain())

    def _rank(self, priorities: dict[str, int]) -> None:
        for entry in self._files.sbs.rtpus:
            turns = self._turns[entry.name]
            tasks = [task.member.task for task in turns.tasks]
            assigned = verify.criticalities(tasks, entry, limit=PLANNED)
            for task in turns.tasks:
                task.crit = task.source.crit = assigned[task.name].crit
                task.priority = priorities[task.name]
                turns.configure(task)

    # -- running ----------------------------------------------------------------------

    def _turn(self, turns: _Turns) -> None:
        """Let every task run that has a release now, the most urgent one first."""
        while task := turns.next(self.now_ns):
            self._cycle(task)
            turns.done(task)

    def _cycle(self, task: SimTask) -> None:
        dt = (self.now_ns - task.last_ns) * 1e-9 if task.last_ns else None
        task.last_ns = self.now_ns
        stable = task.member.rmod.critical and bool(self.table.causes)
        task.copies.committed = False
        task.executor.cycle(dt or task.period_ns * 1e-9, self.now_ns)
        if task.copies.committed:
            task.record.add(
                task.copies.group(),
                release_ns=self.now_ns,
                cycle=task.source.cyclecount,
                start_ns=self.now_ns,
                end_ns=self.now_ns,
                flags=STABLE if stable else 0,
            )
        notices = task.outbox.drain()
        if task.executor.state is not State.ON or notices:
            self._after(task, notices)

    def _after(self, task: SimTask, notices: Iterable[Notice]) -> None:
        """Take note of what a task said and of the state it is in now."""
        state = task.executor.state
        on = state is State.ON
        if self._turns[task.member.rtpu].mode(task, on=on) and on:
            task.on_ns, task.last_ns = self.now_ns, 0
            task.warnings, task.warning = 0, ""
        for notice in notices:
            if notice.bits & Signal.WARNING:
                task.warnings += 1
                task.warning = task.warning or notice.text
            if notice.text:
                self.events.append(f"{self._clock()} {task.name}: {notice.text}")
        self._judge()

    def _judge(self) -> None:
        """Raise or clear the illegal-configuration flag: equation 2 of 3.3.1."""
        on = [task for task in self._tasks.values() if task.executor.state is State.ON]
        written = Counter(name for task in on for name in task.member.task.outputs)
        self.table.causes = {
            f"{task.name} reads {name}, which nobody writes"
            for task in on
            for name in task.member.task.inputs
            if not written[name]
        }

    def _end(self) -> None:
        """Turn off and kill whatever is there; failures are events."""
        on = [task for task in self._tasks.values() if task.executor.state is State.ON]
        order = verify.off_order([t.member.task for t in on], self.job.off_order)
        steps = [(name, "off") for name in order]
        steps += [
            (name, "kill")
            for name, state in reversed(self.states().items())
            if state is not State.NOT_CREATED
        ]
        for name, signal in steps:
            try:
                self.signal(name, signal)
            except StateError:  # `off` failed and left it in ERROR; `kill` follows
                continue
            except PbonetError as error:
                self.events.append(f"{self._clock()} {name}: {error}")

    def _clock(self) -> str:
        return f"{(self.now_ns - BEGIN_NS) * 1e-9:.3f} s"


class _Turns:
    """The dispatcher of one RTPU, and the tasks in its slots."""

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


def simulate(
    path: str | Path, seconds: float, folders: Iterable[str | Path] = ()
) -> Recording:
    """Run a job in virtual time and return every cycle of it.

    Args:
        path: The ``.job`` file.
        seconds: How much virtual time passes while the tasks are ON.
        folders: Of module libraries.

    Raises:
        PbonetError: The job cannot be assembled.
    """
    simulation = Simulation(path, folders)
    recording = simulation.run(seconds)
    recording.about |= {"seconds": seconds, "events": simulation.events}
    return recording
