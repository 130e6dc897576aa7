"""The autonomous interface: a subsystem as a program steers it (Stewart 1994, 4.4.4).

The other interfaces (prompt, script, network, one-shot verbs) call these methods and
nothing else, so whatever can be done in one can be done in all.

::

    with Subsystem("arm.sbs") as arm:
        arm.spawn("jtball")
        arm.control("jtball", "on")

Leaving the block stops the subsystem (`sbsFinish`); `detach` leaves it running.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Self

from msgspec import structs

from pbonet.analysis import legality
from pbonet.config import Library
from pbonet.errors import NodeError, PbonetError
from pbonet.master.configuration import (
    Files,
    RealClock,
    environment,
    must_be_answerable,
    must_be_stopped,
)
from pbonet.xm.net import messages as m, rpc, session

from . import assembly, constants, status_fields
from .argument_text import (
    check_rate,
    check_signal,
    collector,
    local_words,
    log_warning,
)
from .change_transaction import Changing
from .command_methods import Calls
from .condition_gate import in_time
from .recording_control import book
from .rtpu_clients import Fleet, client_name
from .subsystem_tasks import CONTROL_TIME, Crew
from .switching import Switching
from .task_signal_inbox import Inbox, Signalled

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path
    from types import TracebackType

    import zenoh

    from pbonet.config import SbsFile
    from pbonet.master.configuration import Clock, Picture
    from pbonet.master.sim import VirtualRtpus

    from .embedded_agents import Embedded


class Subsystem(Switching, Calls, Signalled):
    """A subsystem of tasks on one or more RTPUs, steered by this master.

    Args:
        path: Its ``.sbs`` file, or a ``.job`` file that names it.
        domain: The domain of its RTPUs; None for PBONET_DOMAIN.
        connect: Endpoints of agents on other machines; None for PBONET_CONNECT.
        libraries: Folders with RMODs and modules of one's own; None for PBONET_LIBRARY.
        kind: What the master is, as the first part of its client name.
        watch: Look only: claim nothing, change nothing.
        take_over: Replace a master that lives.
        embed: Start agents for RTPUs that nobody runs; they end with the subsystem.
        virtual: Run in virtual time, in this process, without agents and devices: time
            passes where the program waits.
        partly: Be content with the RTPUs that answer; of the others it is warned.
        warned: Called with each warning, one sentence, unless a `Desk` collects it.
        record: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None for what the job
            says, or outputs. In virtual time nothing is, and only ``off`` may be said.

    Raises:
        ConfigError: A file is missing or wrong.
        StateError: A log is asked for in virtual time.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        domain: str | None = None,
        connect: Sequence[str] | None = None,
        libraries: Sequence[str | Path] | None = None,
        kind: str = "master",
        watch: bool = False,
        take_over: bool = False,
        embed: bool = False,
        virtual: bool = False,
        partly: bool = False,
        warned: Callable[[str], None] = log_warning,
        record: str | None = None,
    ) -> None:
        domain, connect, libraries = environment.told(domain, connect, libraries)
        self.files: Files = Files(path, Library(libraries))
        self.domain = domain
        self.warned = warned
        self.stopped = threading.Event()
        """Set by `stop`; an assembly that is under way then gives up."""
        self.watch = watch
        self.simulation: VirtualRtpus | None = None
        """The RTPUs in virtual time; it has the ``recording``."""
        self.clock: Clock = RealClock()
        if virtual:
            from pbonet.master import sim  # with it come the RTPU and the task

            self.simulation = sim.VirtualRtpus(self.files)
            self.clock = sim.VirtualClock(self.simulation)
        self._agents: Embedded | None = None
        if embed and not virtual:
            from .embedded_agents import Embedded

            self._agents = Embedded(
                domain, libraries=[*map(str, libraries)], connect=connect
            )
        self.shown = status_fields.DEFAULT
        """Fields that `status` shows; `status_set` chooses them."""
        self.baselines = status_fields.Baselines()
        self.logbook = book(record, virtual=virtual)
        self._connect = connect
        self._kind = kind
        self._take_over = take_over
        self._partly = partly
        self.inbox = Inbox()
        self._crew: Crew | None = None
        self._busy = threading.RLock()

    # -- opening and closing ----------------------------------------------------------

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._crew is None:
            return
        if self.watch:
            self.detach()
        else:
            self.quit()

    @property
    def name(self) -> str:
        """The subsystem's name."""
        return self.files.sbs.subsystem

    @property
    def sbs(self) -> SbsFile:
        """What its ``.sbs`` file says."""
        return self.files.sbs

    @property
    def crew(self) -> Crew:
        """Its tasks and RTPUs, and the steps that commands are made of.

        Raises:
            NodeError: The subsystem is not open.
        """
        if self._crew is None:
            raise NodeError(
                "the subsystem is not open",
                where=self.name,
                remedy="open it, or use it as 'with Subsystem(...) as name:'",
            )
        return self._crew

    @property
    def fleet(self) -> Fleet:
        """Its RTPUs."""
        return self.crew.fleet

    @property
    def picture(self) -> Picture:
        """Its tasks as they stood at the last look."""
        return self.crew.picture

    def open(
        self,
        opened: zenoh.Session | None = None,
        *,
        once: bool = False,
        task: str = "",
    ) -> Self:
        """Connect, claim the RTPUs, open the table, and learn what stands already.

        Args:
            opened: A session to go through, which is ours from now on; None opens one.
            once: One command follows immediately, for which the status that is learned
                here is new enough.
            task: That command concerns this task alone: claim and ask only its RTPU.

        Raises:
            UnreachableError: No agent, or not every agent, can be reached.
            ClaimError: An RTPU belongs to another subsystem or another master.
            SeveralError: Several RTPUs cannot be had.
            SvarError: The table cannot be opened.
        """
        if self._agents is not None:
            rtpus = [entry.name for entry in self.files.sbs.rtpus]
            self._agents.start(self._agents.missing(rtpus))
        try:
            self._crew = self._open(self._client(opened), task, once=once)
        except BaseException:
            self._end_agents()
            raise
        return self

    def _client(self, opened: zenoh.Session | None) -> rpc.Client:
        """Return who asks the RTPUs."""
        name = client_name(self._kind)

        def warned(rtpu: str, text: str) -> None:
            self._warn(f"{rtpu}: {text}")

        if self.simulation is not None:
            return self.simulation.client(self.domain, name, warned)
        opened = opened or session.client(self.domain, connect=self._connect)
        return rpc.Client(opened, self.domain, name, warned=warned)

    def _open(self, client: rpc.Client, task: str, *, once: bool) -> Crew:
        fleet = Fleet(client, self.files.sbs)
        crew = Crew(self.files, fleet, self._warn, self.logbook, self.inbox)
        try:
            if not self.watch:
                crew.take(take_over=self._take_over, partly=self._partly, task=task)
            self.inbox.clear()
            statuses = crew.refresh(
                strict=False, rtpus=list(fleet.epochs) if task else None
            )
            for rtpu in statuses:
                self.inbox.begin(rtpu.tasks)
            if once:
                crew.reuse(statuses)
        except BaseException:
            fleet.drop()
            client.close()
            raise
        return crew

    def _end_agents(self) -> None:
        if self._agents is not None:
            for rtpu in self._agents.stop():
                self._warn(f"the embedded agent of {rtpu} had to be killed")

    def detach(self) -> None:
        """Leave: the tasks go on, and the next master finds them as they are.

        Those of embedded agents end with their agents.
        """
        if self._crew is not None:
            fleet = self._crew.fleet
            self._crew = None
            fleet.drop()
            fleet.client.close()
            self._end_agents()

    def finish(self) -> list[PbonetError]:
        """Turn OFF in order, end every task, give everything back (`sbsFinish`).

        Returns:
            An error for each task that hung: it is ended, but by force.

        Raises:
            SeveralError: Parts of it could not be done, the rest was; of one part, its
                own error.
        """
        self.stopped.set()
        try:
            return assembly.end(self.crew, self.name)
        finally:
            self.detach()

    def network(self, portname: str) -> None:
        """Hand control to a program on the network until it ends (`sbsNetwork`).

        Raises:
            NodeError: The name cannot be one.
            DuplicateNameError: Another master serves a port of this name.
        """
        from pbonet.master.console import serve

        serve(self, portname)

    def quit(self) -> None:
        """End the subsystem with its last interface, and warn of tasks that hung.

        Raises:
            SeveralError: As `finish`.
        """
        for error in self.finish():
            self._warn(str(error))

    # -- tasks ------------------------------------------------------------------------

    def spawn(
        self, rmod: str, rtpu: str | None = None, hz: float | None = None
    ) -> m.TaskStatus:
        """Create a task from an RMOD; when this returns it is OFF (section 4.5.2).

        Args:
            rmod: The RMOD's name; it is also the task's.
            rtpu: Where; by default where the RMOD says, else the first RTPU.
            hz: Its frequency; by default what the RMOD says.

        Raises:
            ConfigError: There is no such RMOD, or its file is wrong.
            StateError: The subsystem has a task of this name.
            ParameterError: `hz` is no frequency.
            VerificationError: It does not fit the table or its module.
            PbonetError: The module does not load, or its `init` failed.
        """
        if hz is not None:
            check_rate(rmod, hz)
        with self._changing() as crew:
            member = crew.plan(self.files.rmod(rmod), rtpu, hz)
            crew.must_be_new(member)
            crew.judge(legality.spawn(member.task))
            try:
                constants.at_hand(crew, member)
                status = crew.create(member, hz)
                constants.given(crew, member.name)
                return status
            finally:
                crew.settle()

    def control(self, task: str, signal: str, arg: str = "") -> m.TaskStatus:
        """Send ``on off kill clear reinit`` to a task (section 4.5.3).

        An ``on`` is verified first: it may not make two tasks write one variable. It
        may leave inputs without a producer, for a loop is built task by task; then it
        warns, and the illegal-configuration flag is up until the loop is closed. The
        other signals are never refused for legality.

        Args:
            task: The task.
            signal: What to send.
            arg: Text for the module, as its ``self.task.arg``.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: The signal is not valid in the task's state.
            VerificationError: ``on`` would make the configuration illegal.
            PbonetError: A method of the module failed.
        """
        check_signal(signal)
        rtpus = self.crew.concerned([task])
        with self._changing(strict=signal == "on", rtpus=rtpus) as crew:
            crew.home(task, signal)
            if signal == "on":
                crew.judge(legality.signal(task, signal))
            try:
                with constants.signals(crew, [(task, signal)]):
                    return crew.control(task, signal, arg)
            finally:
                crew.settle()

    def freq(self, task: str, hz: float | None = None) -> float:
        """Return a task's frequency in Hz; with `hz`, set it first.

        Raises:
            UnknownTaskError: There is no such task.
            ClaimError: It is to be set, and the subsystem is open for watching only.
            ParameterError: `hz` is no frequency.
            VerificationError: The RTPU could not bear the new rate.
        """
        if hz is None:
            return self.crew.ask(task, m.Freq(task=task), float)
        check_rate(task, hz)
        with self._changing(rtpus=[self.crew.locate(task)]) as crew:
            member = crew.picture.find(task)
            crew.judge(legality.frequency(structs.replace(member.task, freq=hz)))
            request = m.Freq(task=task, hz=hz)
            try:
                member.freq = self.fleet.call(member.rtpu, request, float)
                return member.freq
            finally:
                crew.keep()

    def get(self, task: str, param: str | None = None) -> list[m.ParamValue]:
        """Return the parameters of a task's module, or the one named.

        Raises:
            UnknownTaskError: There is no such task.
            ParameterError: It has no such parameter.
        """
        request = m.Get(task=task, name=param)
        return self.crew.ask(task, request, list[m.ParamValue])

    def set(
        self, task: str, param: str | None = None, value: object = None
    ) -> list[m.ParamValue]:
        """Change a parameter of a task between two cycles, within its bounds.

        Args:
            task: The task.
            param: The parameter.
            value: A number, a word, or several of them, as in a LOCAL line; None: only
                look, as `get` does.

        Raises:
            UnknownTaskError: There is no such task.
            ParameterError: No such parameter, or a value that it does not take.
        """
        if param is None or value is None:
            return self.get(task, param)
        request = m.Set(task=task, name=param, value=local_words(value))
        with self._changing(rtpus=[]) as crew:
            return crew.ask(task, request, list[m.ParamValue], timeout=CONTROL_TIME)

    def write(self, variable: str, value: float | Iterable[float]) -> m.VarValue:
        """Set a variable that no task writes; who has it as in-const takes it in.

        Raises:
            UnknownVariableError: The table has no such variable.
            SvarOwnerError: A task writes it.
        """
        with self._changing(strict=False) as crew:
            self.files.must_have(variable)
            values = [value] if isinstance(value, (int, float)) else value
            request = m.Write(name=variable, values=[float(one) for one in values])
            keeper = self.sbs.keeper
            with constants.followed(crew, f"{variable} was set", {variable: keeper}):
                return self.fleet.call(keeper, request, m.VarValue)

    # -- the whole --------------------------------------------------------------------

    def start(
        self, job: str | Path | None = None, *, wait: float | None = None
    ) -> list[m.TaskStatus]:
        """Assemble a job: verify, spawn until all are OFF, then turn ON.

        Its PRE must hold. A start that fails is rolled back: what it turned on goes
        off, what it spawned is killed.

        Args:
            job: The ``.job`` file or its name; None where the subsystem was opened with
                one.
            wait: Seconds that PRE has to come true; None: it must hold now.

        Raises:
            VerificationError: It would be illegal, or a condition cannot be answered;
                nothing was done.
            ConditionError: One does not hold, and says what was seen; nothing was done.
            PbonetError: A step failed; it was rolled back.
        """

        def attempt() -> list[m.TaskStatus]:
            with self._changing() as crew:
                wanted = self.files.read_job(job)
                self.logbook.of(wanted, self.files)
                try:
                    return assembly.start(crew, wanted, self.stopped)
                finally:
                    crew.settle()

        return in_time(attempt, wait, self.clock, self.stopped)

    def check(self, job: str | Path | None = None) -> list[str]:
        """Judge a job, or the tasks as they stand, without changing anything.

        Returns:
            Warnings.

        Raises:
            VerificationError: It would be, or is, illegal.
        """
        with self._busy:
            return self.crew.verdict(self._change(job))

    def report(self, job: str | Path | None = None) -> list[legality.RtpuReport]:
        """Return the analysis of a job, or of what stands, be it legal or not."""
        with self._busy:
            return self.crew.report(self._change(job))

    def _change(self, job: str | Path | None) -> legality.Change | None:
        """Return what a check is about; None for the tasks as they stand."""
        self.crew.refresh()
        if job is None and self.files.job is None:
            return None
        wanted = self.files.read_job(job)
        must_be_answerable(wanted, self.files.table.variables)
        return assembly.change(self.crew, wanted)

    def stop(self) -> m.Stopped:
        """Turn everything OFF and end it, now, on all RTPUs at once.

        Always accepted: it needs no verification, no claim, and no other command to be
        finished.

        Raises:
            SeveralError: An RTPU did not confirm; the others were stopped.
        """
        self.stopped.set()
        stopped, errors = self.crew.stop()
        self.inbox.clear()
        must_be_stopped(stopped, errors)
        if self.fleet.claimed:
            self.crew.settle()
        return stopped

    def _warn(self, text: str) -> None:
        """Hand a warning to the command that gave it, else to whoever listens."""
        (collector() or self.warned)(text)

    def _changing(
        self,
        *,
        strict: bool = True,
        claimed: bool = True,
        rtpus: Sequence[str] | None = None,
    ) -> Changing:
        return Changing(
            self.crew, self._busy, strict=strict, claimed=claimed, rtpus=rtpus
        )
