"""A job in virtual time: one thread, no devices, the same result every time.

The modules are loaded, bound and run as in a task process, by the same executor. Copies
go to a table in plain memory, and releases are granted by the rules of the dispatcher
(`dispatch`), one for each RTPU. A cycle takes no virtual time: at one
instant the RTPUs have their turn in the order of the ``.sbs`` file, and on each the
more urgent task first. So a simulation shows what the control laws do; how long they
take, and what a late cycle does, only a run in real time shows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from pbonet.analysis import legality
from pbonet.analysis.schedule import PLANNED
from pbonet.config import JobTask, Library, TaskType
from pbonet.errors import (
    PbonetError,
    Severity,
    StateError,
    UnknownTaskError,
    did_you_mean,
)
from pbonet.io import no_devices
from pbonet.log import STABLE
from pbonet.master.configuration import Files, Member, conditions, stuck
from pbonet.pbo import Signal, State
from pbonet.xm.net import messages as m

from .sim_create_task import make
from .sim_events import SimEvents
from .sim_recording import Recording
from .sim_standby import Standbys, members
from .sim_table import MemoryTable
from .sim_task import SimTask, Turns, must_be_simulated, rtpu_status, unwritten

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from pbonet.config import JobFile
    from pbonet.pbo import Notice

    from .sim_log import SimLog

REASON = "this is a simulation"
BEGIN_NS = 1_000_000_000
"""The virtual clock's first instant."""


class Simulation:
    """One job, from its assembly to its end.

    Args:
        path: The ``.job`` file.
        folders: Of module libraries, beside those of pbonet and installed packages.
        log: Where it is recorded; without, every cycle is kept in memory.

    Attributes:
        recording: Every cycle so far, unless there is a log.
        events: What went wrong or was said so far, one text each.

    Raises:
        ConfigError: A file is missing or wrong.
    """

    simulated: ClassVar[tuple[TaskType, ...]] = (
        TaskType.PERIODIC,
        TaskType.SYNCHRONOUS,
    )

    def __init__(
        self,
        path: str | Path,
        folders: Iterable[str | Path] = (),
        log: SimLog | None = None,
    ) -> None:
        files = Files(path, Library(folders))
        self.job: JobFile = files.read_job()
        self._begin(files, {"job": self.job.name, "file": self.job.file}, log)

    def _begin(
        self, files: Files, about: dict[str, str], log: SimLog | None = None
    ) -> None:
        """Begin with no task, at the first instant."""
        self.log = log
        self._files, self._library = files, files.library
        self.table = MemoryTable(files.table.variables)
        self.now_ns = BEGIN_NS
        self.recording = Recording({**about, "mode": "simulation"})
        self.events: list[str] = []
        self._tasks: dict[str, SimTask] = {}
        self._turns = {rtpu.name: Turns() for rtpu in files.sbs.rtpus}
        name, tell = files.sbs.subsystem, self._engaged
        self.happened = SimEvents(
            self._turns, name, lambda: self.now_ns, lambda task: self.states().get(task)
        )
        if log is not None:
            log.begun(self.happened)
        self._steady = False
        """Whether what raises the flag is an event: not while a job begins or ends."""
        self._standbys = Standbys(
            name, self._tasks, self._turns, signal=self.signal, tell=tell
        )

    # -- the job ----------------------------------------------------------------------

    def start(self) -> None:
        """Verify the job, spawn its tasks and turn them on.

        Raises:
            VerificationError: The configuration would be illegal.
            ConditionError: PRE of the job does not hold.
            PbonetError: A module is missing, or its `init` or `on` failed; everything
                is undone.
        """
        wanted = [one for task in self.job.tasks for one in self._members(task)]
        by_name = {member.name: member for member in wanted}
        tasks = [member.task for member in wanted]
        self._check(legality.job(tasks))
        variables = self._files.table.variables
        conditions.must_be_answerable(self.job, variables)
        asked = [conditions.Asked("PRE", self.job.name, one) for one in self.job.pre]
        conditions.must_hold(asked, variables, self.display)
        with no_devices(REASON):
            try:
                for name in legality.spawn_order(tasks):
                    self._spawn(by_name[name])
                self._rank()
                originals = [task for task in tasks if not task.fallback_of]
                for name in legality.on_order(originals):
                    self.signal(name, "on")
                self._standbys.begin(wanted)
                self._steady = True
            except BaseException:
                self._end()
                raise

    def advance(self, seconds: float) -> None:
        """Let virtual time pass, as fast as the modules can be run."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.step(end_ns):
            pass
        if self.log is not None:
            self.log.turn(self.now_ns)

    def step(self, end_ns: int) -> bool:
        """Go on to the next instant at which something is due, at most to an end.

        Returns:
            Whether it was before the end.
        """
        due = [t.due_ns for t in self._turns.values() if t.due_ns]
        if not due or min(due) > end_ns:
            self.now_ns = end_ns
            return False
        self.now_ns = max(self.now_ns, min(due))
        with no_devices(REASON):
            for turns in self._turns.values():
                if 0 < turns.due_ns <= self.now_ns:
                    self._turn(turns)
        return True

    def signal(
        self,
        task: str,
        name: str,
        arg: str = "",
        *,
        handover: bool = False,
        replaces: Sequence[str] = (),
    ) -> State:
        """Send ``on``, ``off``, ``kill``, ``clear`` or ``reinit`` to a task.

        Args:
            task: The task.
            name: What is sent.
            arg: Text for the module.
            handover: For ``off`` and ``kill``: a successor takes over the outputs.
            replaces: For ``reinit``: tasks that leave, whose constants it takes over.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: The signal is not valid in its state.
            PbonetError: A method of the module failed.
        """
        found = self.task(task)
        self._standbys.dismiss(found)
        found.copies.replaces = replaces
        with no_devices(REASON):
            failed: PbonetError | None = None
            try:
                return found.executor.signal(name, arg, handover=handover)
            except PbonetError as error:
                failed = error
                raise
            finally:
                found.copies.replaces = ()
                self._after(found, found.outbox.drain())
                if not isinstance(failed, StateError):  # nothing happened
                    self.happened.signalled(found, name, failed)

    def spawn(
        self, rmod: str, rtpu: str | None = None, freq: float | None = None
    ) -> SimTask:
        """Create one more task; it is OFF, as by `Subsystem.spawn`.

        Raises:
            ConfigError: There is no such RMOD, or its file is wrong.
            StateError: There is a task of this name.
            VerificationError: It does not fit the table or its module.
            PbonetError: The module does not load, or its `init` failed.
        """
        member = self._member(JobTask(rmod=rmod, rtpu=rtpu, freq=freq))
        if member.name in self._tasks:
            raise StateError(
                f"the simulation has a task {member.name} already",
                remedy="an RMOD is one task; copy it under another name for a second",
            )
        self._check(legality.spawn(member.task))
        with no_devices(REASON):
            self._spawn(member)
            self._rank()
        return self.task(member.name)

    def reconfig(self, items: Sequence[tuple[str, str]]) -> dict[str, State]:
        """Send an ordered list of signals at one instant; it is judged by its end.

        Args:
            items: Pairs of task and signal.

        Returns:
            The states of the tasks concerned.

        Raises:
            UnknownTaskError: There is no such task; nothing was sent.
            VerificationError: The end would be illegal; nothing was sent.
            ReconfigError: An item failed; it says which, and what was not sent.
        """
        for task, _ in items:
            self.task(task)
        self._check(legality.reconfig(items))
        states: dict[str, State] = {}
        for done, (task, name) in enumerate(items):
            try:
                heir = name == "off" and self._has_heir(task, items[done + 1 :])
                states[task] = self.signal(task, name, handover=heir)
            except PbonetError as error:
                raise stuck(items, done, error) from error
        return states

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

    def display(self, names: Sequence[str]) -> list[m.VarValue]:
        """Return values of variables, of this instant."""
        return [self.table.look(name, self.now_ns) for name in names]

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
        tasks, illegal = [*self._tasks.values()], sorted(self.table.illegal)
        rtpus = self._files.sbs.rtpus
        return [rtpu_status(rtpu, tasks, illegal, self.now_ns) for rtpu in rtpus]

    # -- assembling -------------------------------------------------------------------

    def _member(self, wanted: JobTask) -> Member:
        source = self._files.rmod(wanted.rmod)
        record = source.record
        rtpu = wanted.rtpu or record.rtpu or self._files.sbs.rtpus[0].name
        freq = wanted.freq or record.freq
        must_be_simulated(
            record, freq, self.simulated, str(wanted.place or self.job.file)
        )
        info = self._library.load_rmod(record).info
        return Member(
            source=source, rtpu=rtpu, freq=freq or 0.0, info=info, told=wanted.told
        )

    def _members(self, task: JobTask) -> list[Member]:
        """Return a task of the job, and its fallback."""
        return members(self._member, task)

    def _has_heir(self, task: str, rest: Sequence[tuple[str, str]]) -> bool:
        """Tell whether a list goes on to turn on who writes what `task` writes."""
        outputs = {*self.task(task).copies.out_vars}
        return any(
            signal == "on" and outputs & {*self.task(other).copies.out_vars}
            for other, signal in rest
        )

    def _check(self, change: legality.Change) -> None:
        """Refuse a change that would be illegal; its warnings are events.

        Raises:
            VerificationError: It would be.
        """
        verdict = self._judged(change, producers=False)
        if verdict.problems:
            verdict = self._judged(change, producers=True)
        verdict.check()
        self.events += map(legality.as_text, verdict.warnings)

    def _judged(self, change: legality.Change, *, producers: bool) -> legality.Verdict:
        """Judge a change; with `producers`, remedies can name RMODs of the library."""
        now = legality.Configuration(
            svar=self._files.table,
            tasks=tuple(task.member.task for task in self._tasks.values()),
            on=frozenset(n for n, state in self.states().items() if state is State.ON),
            rtpus=self._files.sbs.rtpus,
            producers=self._files.producers() if producers else {},
            limit=PLANNED,
        )
        return legality.judge(now, change)

    def _spawn(self, member: Member, replaces: Sequence[str] = ()) -> None:
        turns = self._turns[member.rtpu]
        task = make(
            member,
            self._library,
            self.table,
            lambda: self.now_ns,
            slot=len(turns.tasks),
            keep=None if self.log else self.recording,
            log=self.log,
        )
        self._tasks[member.name] = task
        turns.add(task)
        task.copies.replaces = replaces
        try:
            task.executor.spawn()
        except PbonetError as error:
            self.happened.not_spawned(task, error)
            raise
        task.copies.replaces = ()
        self._after(task, task.outbox.drain())
        self.happened.spawned(task)

    def _rank(self) -> None:
        everyone = [task.member.task for task in self._tasks.values()]
        priorities = legality.user_priorities(everyone)
        for entry in self._files.sbs.rtpus:
            turns = self._turns[entry.name]
            here = [t for t in turns.tasks if self._tasks.get(t.name) is t]
            tasks = [task.member.task for task in here]
            assigned = legality.criticalities(tasks, entry, limit=PLANNED)
            for task in here:
                task.crit = task.source.crit = assigned[task.name].crit
                task.priority = priorities[task.name]
                turns.configure(task)

    # -- running ----------------------------------------------------------------------

    def _turn(self, turns: Turns) -> None:
        """Let every task run that has a release now, the most urgent one first."""
        while task := turns.next(self.now_ns):
            if task.stands_by:
                self._standbys.engage(task)
            else:
                self._cycle(task)
                turns.done(task)

    def _cycle(self, task: SimTask) -> None:
        dt_ns = (self.now_ns - task.last_ns) if task.last_ns else 0
        task.last_ns = self.now_ns
        stable = task.member.rmod.critical and bool(self.table.illegal)
        task.copies.committed = False
        task.executor.run_cycle(dt_ns or task.period_ns, self.now_ns, stable=stable)
        if task.copies.committed and task.record is not None:
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
        if task.executor.state is not State.ON or task.executor.faulted:
            self.happened.cycled(task)

    def _after(self, task: SimTask, notices: Sequence[Notice]) -> None:
        """Take note of what a task said and of the state it is in now."""
        state = task.executor.state
        on = state is State.ON
        fell = state is State.ERROR
        if self._turns[task.member.rtpu].mode(task, on=on, fell=fell) and on:
            task.on_ns, task.last_ns = self.now_ns, 0
            task.warnings, task.warning = 0, ""
        for notice in notices:
            if notice.bits & Signal.WARNING:
                task.warnings += 1
                task.warning = task.warning or notice.text
            if notice.text:
                self.events.append(f"{self._clock()} {task.said(notice)}")
        self.happened.noticed(task, notices)
        self._look_for_causes()
        self.happened.flagged(self.table.illegal, told=self._steady)
        self._standbys.look()

    def _look_for_causes(self) -> None:
        self.table.causes = unwritten(self._tasks.values())

    def _engaged(self, task: SimTask, severity: Severity, text: str) -> None:
        """Tell that a standby was engaged."""
        self.happened.tell(task, severity, "FALLBACK", text)
        self.events.append(f"{self._clock()} {text}")

    def _end(self) -> None:
        """Turn off and kill whatever is there; failures are events."""
        self._standbys.forget()
        self._steady = False
        on = [task for task in self._tasks.values() if task.executor.state is State.ON]
        order = legality.off_order([t.member.task for t in on], self.job.off_order)
        steps = [(name, "off") for name in order]
        steps += [
            (name, "kill")
            for name, state in reversed(self.states().items())
            if state is not State.NOT_CREATED
        ]
        with self.happened.stopping():
            for name, signal in steps:
                try:
                    self.signal(name, signal)
                except StateError:  # `off` failed and left it in ERROR; `kill` follows
                    continue
                except PbonetError as error:
                    self.events.append(f"{self._clock()} {name}: {error}")

    def _clock(self) -> str:
        return f"{(self.now_ns - BEGIN_NS) * 1e-9:.3f} s"


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
