"""A job in virtual time: one thread, no devices, the same result every time.

The RTPUs are those of `virtual_rtpus`; here is what a master does for a job. A cycle
takes no virtual time. So a simulation shows what the control laws do; how long they
take, and what a late cycle does, only a run in real time shows.
"""

from __future__ import annotations

from itertools import groupby
from types import NoneType
from typing import TYPE_CHECKING, TypeVar

from pbonet.analysis import legality
from pbonet.analysis.schedule import PLANNED
from pbonet.config import JobTask, Library
from pbonet.errors import (
    PbonetError,
    StateError,
    UnknownTaskError,
    did_you_mean,
)
from pbonet.master.configuration import Files, Member, TaskModel, conditions, stuck
from pbonet.node.task import placed
from pbonet.pbo import Signal, State
from pbonet.xm.net import messages as m

from .rtpu_in_process import must_be_simulated
from .virtual_loop import BEGIN_NS
from .virtual_rtpus import VirtualClient, VirtualRtpus

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from pbonet.config import JobFile

    from .sim_log import SimLog
    from .sim_recording import Recording

T = TypeVar("T")

_TOLD = frozenset({"WARNING", "SIGNAL", "HANDLED", "METHOD", "FALLBACK"})
"""Codes of the events that are reported when the simulation has ended."""


class Simulation(VirtualRtpus):
    """One job, from its assembly to its end.

    Args:
        path: The ``.job`` file.
        folders: Of module libraries, beside those of pbonet and installed packages.
        log: Where it is recorded; without, every cycle is kept in memory.

    Attributes:
        events: What went wrong or was said so far, one text each.

    Raises:
        ConfigError: A file is missing or wrong.
    """

    def __init__(
        self,
        path: str | Path,
        folders: Iterable[str | Path] = (),
        log: SimLog | None = None,
    ) -> None:
        files = Files(path, Library(folders))
        self.job: JobFile = files.read_job()
        self.events: list[str] = []
        self._model = TaskModel()
        self._steady = False
        """Whether inputs that no task writes raise the flag: not while a job begins or
        ends."""
        self._unwritten: set[str] = set()
        super().__init__(files, {"job": self.job.name, "file": self.job.file})
        self._client = VirtualClient(self, "", "simulation")
        self._epochs: dict[str, int] = {}
        self._take()
        if log is not None:
            self.log, self.epoch_ns = log, log.epoch_ns

    def _take(self) -> None:
        """Claim the RTPUs and open the table, as a master does."""
        entries = self.files.sbs.rtpus
        for entry in sorted(entries, key=lambda entry: entry.name != self._keeper):
            claim = m.Claim(
                usage=entry.usage,
                scheduler=entry.scheduler,
                minfreq=entry.minfreq,
                maxfreq=entry.maxfreq,
                svar=self.files.table_text,
                svar_name=self.files.table.file,
                keep=entry.name == self._keeper,
            )
            self._epochs[entry.name] = self._ask(entry.name, claim, m.Claimed).epoch

    @property
    def _keeper(self) -> str:
        return self.files.sbs.keeper

    def _ask(self, rtpu: str, request: m.Request, result: type[T]) -> T:
        """Send a request to an RTPU under the claim on it."""
        request.subsystem = self.files.sbs.subsystem
        request.epoch = self._epochs.get(rtpu, 0)
        return self._client.call(rtpu, request, result)

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
        variables = self.files.table.variables
        conditions.must_be_answerable(self.job, variables)
        asked = [conditions.Asked("PRE", self.job.name, one) for one in self.job.pre]
        conditions.must_hold(asked, variables, self.display)
        try:
            for name in legality.spawn_order(tasks):
                self._spawn(by_name[name])
            self._rank()
            originals = [task for task in tasks if not task.fallback_of]
            for name in legality.on_order(originals):
                self.signal(name, "on")
            for member in wanted:
                if member.fallback_of:
                    standby = m.Standby(task=member.name, original=member.fallback_of)
                    self._ask(member.rtpu, standby, m.TaskStatus)
            self._steady = True
        except BaseException:
            self.stop()
            raise

    def advance(self, seconds: float) -> None:
        """Let virtual time pass, as fast as the modules can be run."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.step(end_ns):
            pass
        if self.log is not None:
            self.log.turn(self.now_ns)

    def signal(self, task: str, name: str, arg: str = "") -> State:
        """Send ``on``, ``off``, ``kill``, ``clear`` or ``reinit`` to a task.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: The signal is not valid in its state.
            PbonetError: A method of the module failed.
        """
        request = m.Control(task=task, signal=name, arg=arg)
        status = self._ask(self.task(task).rtpu, request, m.TaskStatus)
        self._judge_inputs()
        return State(status.state)

    def spawn(
        self, rmod: str, rtpu: str | None = None, freq: float | None = None
    ) -> Member:
        """Create one more task; it is OFF, as by `Subsystem.spawn`.

        Raises:
            ConfigError: There is no such RMOD, or its file is wrong.
            StateError: There is a task of this name.
            VerificationError: It does not fit the table or its module.
            PbonetError: The module does not load, or its `init` failed.
        """
        member = self._member(JobTask(rmod=rmod, rtpu=rtpu, freq=freq))
        if member.name in self._model:
            raise StateError(
                f"the simulation has a task {member.name} already",
                remedy="an RMOD is one task; copy it under another name for a second",
            )
        self._check(legality.spawn(member.task))
        self._spawn(member)
        self._rank()
        return member

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
        handover = self._handed_over(items)
        done, states = 0, dict[str, State]()
        for rtpu, some in groupby(items, lambda item: self.task(item[0]).rtpu):
            request = m.Reconfig(items=list(some), handover=handover)
            found = self._ask(rtpu, request, m.Reconfigured)
            states |= {name: State(state) for name, state in found.states.items()}
            done += found.done
            if found.error is not None:
                error = PbonetError.from_wire(found.error)
                raise stuck(items, done, error) from error
        self._judge_inputs()
        return states

    def _handed_over(self, items: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
        """Return for tasks that go off which of their outputs a later item takes."""
        found: dict[str, list[str]] = {}
        for n, (task, signal) in enumerate(items):
            later = [self.task(name) for name, one in items[n + 1 :] if one == "on"]
            taken = {output for one in later for output in one.task.outputs}
            theirs = [one for one in self.task(task).task.outputs if one in taken]
            if signal == "off" and theirs:
                found[task] = theirs
        return found

    def set(self, task: str, name: str, value: str) -> object:
        """Change a parameter of a task; `value` is what a LOCAL line would have."""
        request = m.Set(task=task, name=name, value=value)
        (found,) = self._ask(self.task(task).rtpu, request, list[m.ParamValue])
        return found.value

    def stop(self) -> None:
        """Turn everything off in the job's order, and kill it; failures are events."""
        self._steady = False
        on = [self.task(n) for n, state in self.states().items() if state is State.ON]
        order = legality.off_order([one.task for one in on], self.job.off_order)
        order += [n for n in reversed(self._model.names) if n not in order]
        for rtpu in self.rtpus:
            self._ask(rtpu, m.Stop(order=order), m.Stopped)

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

    # -- state ----------------------------------------------------------------------

    def display(self, names: Sequence[str]) -> list[m.VarValue]:
        """Return values of variables, of this instant."""
        return self._ask(self._keeper, m.Display(names=list(names)), list[m.VarValue])

    def task(self, name: str) -> Member:
        """Return a task.

        Raises:
            UnknownTaskError: There is none of that name.
        """
        member = self._model.get(name)
        if member is None:
            names = self._model.names
            raise UnknownTaskError(
                f"the simulation has no task {name}",
                expected=" or ".join(names) or "a job that was started",
                remedy=did_you_mean(name, names) or "name a task of the job",
            )
        return member

    def states(self) -> dict[str, State]:
        """Return the state of every task."""
        there = {
            task.name: task.state
            for rtpu in self.rtpus.values()
            for task in rtpu.tasks.values()
        }
        for member in self._model:
            member.state = there.get(member.name, State.NOT_CREATED)
        return {member.name: member.state for member in self._model}

    def status(self) -> list[m.RtpuStatus]:
        """Return what `pbonet status` would show; CPU times are not simulated."""
        return [self._ask(name, m.Status(), m.RtpuStatus) for name in self.rtpus]

    # -- assembling -------------------------------------------------------------------

    def _member(self, wanted: JobTask) -> Member:
        source = self.files.rmod(wanted.rmod)
        record = source.record
        rtpu = wanted.rtpu or record.rtpu or self.files.sbs.rtpus[0].name
        freq = wanted.freq or record.freq
        where = str(wanted.place or self.job.file)
        must_be_simulated(record, freq, self.simulated, where)
        info = self.library.load_rmod(record).info
        return Member(
            source=source,
            rtpu=rtpu,
            freq=freq or 0.0,
            info=info,
            job_places=wanted.job_places,
        )

    def _members(self, task: JobTask) -> list[Member]:
        """Return a task of the job, and its fallback."""
        original = self._member(task)
        if task.fallback is None:
            return [original]
        standby = JobTask(rmod=task.fallback, rtpu=original.rtpu, place=task.place)
        member = self._member(standby)
        member.fallback_of = original.name
        return [original, member]

    def _check(self, change: legality.Change) -> None:
        """Refuse a change that would be illegal; its warnings are events.

        Raises:
            VerificationError: It would be.
        """
        verdict = self._judged(change)
        verdict.check()
        self.events += map(legality.as_text, verdict.warnings)

    def _judged(self, change: legality.Change) -> legality.Verdict:
        now = legality.Configuration(
            svar=self.files.table,
            tasks=tuple(member.task for member in self._model),
            on=frozenset(n for n, state in self.states().items() if state is State.ON),
            rtpus=self.files.sbs.rtpus,
            producers=self.files.producers(),
            limit=PLANNED,
        )
        return legality.judge(now, change)

    def _spawn(self, member: Member) -> None:
        self._model.spawned(member)
        request = m.Spawn(
            task=member.name,
            rmod=member.source.text,
            rmod_name=f"{member.name}.rmod",
            freq=member.freq or None,
            crit=member.rmod.crit,
        )
        self._ask(member.rtpu, request, m.TaskStatus)

    def _rank(self) -> None:
        """Tell the RTPUs the user priorities; criticalities are their own rule's."""
        priorities = legality.user_priorities([one.task for one in self._model])
        for rtpu in self.rtpus:
            here = [one for one in self._model if one.rtpu == rtpu]
            ranks = {one.name: (one.rmod.crit, priorities[one.name]) for one in here}
            self._ask(rtpu, m.Rank(tasks=ranks), NoneType)

    # -- what happens ------------------------------------------------------------------

    def _judge_inputs(self) -> None:
        """Raise the flag for inputs that no task writes: equation 2 of 3.3.1."""
        if not self._steady:
            return
        self.states()
        on = [one for one in self._model if one.is_on]
        fell = [one for one in self._model if one.state is State.ERROR]
        written = {name for one in [*on, *fell] for name in one.task.outputs}
        now = {
            f"{one.name} reads {name}, which no task writes"
            for one in on
            for name in one.task.inputs
            if name not in written
        }
        self._flag(now - self._unwritten, up=True)
        self._flag(self._unwritten - now, up=False)
        self._unwritten = now

    def _flag(self, causes: Iterable[str], *, up: bool) -> None:
        for cause in sorted(causes):
            request = m.Flag(cause=cause, up=up)
            self._ask(self._keeper, request, list[str])

    def _published(self, event: m.Event) -> None:
        super()._published(event)
        if event.code in _TOLD and not event.bits & Signal.ERROR:
            text = placed(event.text.removesuffix(f": {event.state}"), event.place)
            at = (event.time - BEGIN_NS) * 1e-9
            self.events.append(f"{at:.3f} s {event.task}: {text}")


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
    try:
        recording = simulation.run(seconds)
    finally:
        simulation.close()
    recording.about |= {"seconds": seconds, "events": simulation.events}
    return recording
