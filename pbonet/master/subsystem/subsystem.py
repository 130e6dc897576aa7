"""The autonomous interface: control by a program (Stewart 1994, 4.4.4).

The other interfaces (prompt, script, network, one-shot verbs) call only these methods,
so every command is available in all of them.

::

    with Subsystem("arm.sbs") as arm:
        arm.spawn("jtball")
        arm.control("jtball", "on")

Leaving the block stops the subsystem (`sbsFinish`); `detach` leaves it running.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Self, overload

from msgspec import structs

from pbonet.analysis import legality
from pbonet.config import Library, Search, search
from pbonet.errors import NoAnswerError, NodeError, PbonetError, StateError
from pbonet.master import configuration
from pbonet.master.configuration import Files, RealClock, environment
from pbonet.xm.net import messages as m, rpc, session

from . import (
    constants,
    remote_modules,
    status_fields,
    task_signal_inbox,
)
from .argument_text import (
    check_rate,
    check_signal,
    check_time,
    collector,
    local_words,
    log_warning,
    matching,
    names_of,
    task_of,
)
from .change_transaction import ChangeTransaction
from .recording_control import book
from .rtpu_clients import RtpuClients, client_name
from .status_fields import columns
from .subsystem_tasks import CONTROL_TIME, SubsystemTasks
from .task_signal_inbox import Inbox, Sent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path
    from types import TracebackType

    import zenoh
    from numpy.typing import NDArray

    from pbonet.config import Found, SbsFile
    from pbonet.master.configuration import Clock, Saved, TaskModel
    from pbonet.master.sim import VirtualRtpus

    from .embedded_agents import Embedded
    from .status_fields import Profile
    from .step_end import StepEnds
    from .switching import Transition


class Subsystem:
    """A subsystem of tasks on one or more RTPUs, controlled by this program.

    Args:
        path: Its ``.sbs`` file, or a ``.job`` file that names it.
        domain: The domain of its RTPUs; None: PBONET_DOMAIN.
        connect: Endpoints of agents on other machines; None: PBONET_CONNECT.
        libraries: Folders with your own RMODs and modules; None: PBONET_LIBRARY.
        kind: The kind of master, as the first part of its client name.
        watch: Only read: claim nothing, change nothing.
        take_over: Replace a master that is still alive.
        confirm: Asked, with a sentence, before tasks that are CRITICAL and ON are taken
            over from a master that lives; without it that is refused.
        embed: Start agents for RTPUs without one; they end with the subsystem. A path:
            they have the settings of this ``agent.toml``.
        virtual: Run in virtual time, in this process, without agents and devices: time
            passes only while the program waits.
        partly: Continue with the RTPUs that answer, and warn about the others.
        warned: Called with each warning, one sentence, unless a `CommandSession`
            collects it.
        record: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None: as the job
            says, or outputs. In virtual time nothing is recorded, and only ``off`` is
            accepted.

    Raises:
        ConfigError: A file is missing or wrong.
        StateError: A log is requested in virtual time.
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
        confirm: Callable[[str], bool] | None = None,
        embed: bool | str | Path = False,
        virtual: bool = False,
        partly: bool = False,
        warned: Callable[[str], None] = log_warning,
        record: str | None = None,
    ) -> None:
        domain, connect, libraries = environment.or_environment(
            domain, connect, libraries
        )
        self.files: Files = Files(path, Library(libraries))
        self.domain = domain
        self.warned = warned
        self.stopped = threading.Event()
        """Set by `stop`; a start in progress is then abandoned."""
        self.stops = 0
        """How often `stop` was called."""
        self.watch = watch
        self.simulation: VirtualRtpus | None = None
        """The RTPUs in virtual time; it has the ``recording``."""
        self.clock: Clock = RealClock()
        if virtual:
            from pbonet.master import sim  # with it come the RTPU and the task

            self.simulation = self.clock = sim.VirtualRtpus(self.files)
        self._agents: Embedded | None = None
        if embed and not virtual:
            from .embedded_agents import Embedded

            folders = [*map(str, self.files.library.folders)]
            settings = None if embed is True else embed
            self._agents = Embedded(
                domain, libraries=folders, connect=connect, settings=settings
            )
        self.shown: tuple[str, ...] = status_fields.DEFAULT
        """Fields that `status` shows; `status_set` sets them."""
        self.baselines = status_fields.Baselines()
        self.recordings = book(record, virtual=virtual)
        self._connect = connect
        self._kind = kind
        self._take_over = take_over
        self._confirm = confirm
        self._partly = partly
        self.inbox = Inbox()
        self._task_set: SubsystemTasks | None = None
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
        if self._task_set is None:
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
        """The record of its ``.sbs`` file."""
        return self.files.sbs

    @property
    def is_open(self) -> bool:
        """Whether it is connected to its RTPUs."""
        return self._task_set is not None

    @property
    def task_set(self) -> SubsystemTasks:
        """Its tasks and RTPUs, and the steps that commands are made of.

        Raises:
            NodeError: The subsystem is not open.
        """
        if self._task_set is None:
            raise NodeError(
                "the subsystem is not open",
                where=self.name,
                remedy="open it, or use it as 'with Subsystem(...) as name:'",
            )
        return self._task_set

    @property
    def clients(self) -> RtpuClients:
        """Its RTPUs."""
        return self.task_set.clients

    @property
    def model(self) -> TaskModel:
        """Its tasks as last read from the RTPUs."""
        return self.task_set.model

    def open(
        self,
        opened: zenoh.Session | None = None,
        *,
        once: bool = False,
        task: str = "",
    ) -> Self:
        """Connect, claim the RTPUs, open the table, and read the existing tasks.

        Args:
            opened: A session to use, which is closed with the subsystem; None: open
                one.
            once: A single command follows immediately and may use the status read here.
            task: That command concerns only this task: claim and ask only its RTPU.

        Returns:
            This subsystem.

        Raises:
            UnreachableError: No agent, or not every agent, can be reached.
            ClaimError: An RTPU belongs to another subsystem or another master.
            SeveralError: Several RTPUs cannot be used.
            SvarError: The table cannot be opened.
        """
        if self._agents is not None:
            rtpus = [entry.name for entry in self.files.sbs.rtpus]
            self._agents.start(self._agents.missing(rtpus))
        try:
            self._task_set = self._open(self._client(opened), task, once=once)
        except BaseException:
            self._end_agents()
            raise
        return self

    def _client(self, opened: zenoh.Session | None) -> rpc.Client:
        """Return the client that sends requests to the RTPUs."""
        name = client_name(self._kind)

        def warned(rtpu: str, text: str) -> None:
            self._warn(f"{rtpu}: {text}")

        if self.simulation is not None:
            return self.simulation.client(self.domain, name, warned)
        opened = opened or session.client(self.domain, connect=self._connect)
        return rpc.Client(opened, self.domain, name, warned=warned)

    def _open(self, client: rpc.Client, task: str, *, once: bool) -> SubsystemTasks:
        clients = RtpuClients(client, self.files.sbs)
        task_set = SubsystemTasks(
            self.files,
            clients,
            self._warn,
            self.recordings,
            self.inbox,
            virtual=self.simulation is not None,
        )
        try:
            if not self.watch:
                task_set.take(
                    take_over=self._take_over,
                    partly=self._partly,
                    task=task,
                    confirm=self._confirm,
                )
            self.inbox.clear()
            statuses = task_set.refresh(
                strict=False, rtpus=list(clients.epochs) if task else None
            )
            for rtpu in statuses:
                self.inbox.begin(rtpu.tasks)
            if once:
                task_set.reuse(statuses)
        except BaseException:
            clients.drop()
            client.close()
            raise
        return task_set

    def _end_agents(self) -> None:
        if self._agents is not None:
            for rtpu in self._agents.stop():
                self._warn(f"the embedded agent of {rtpu} had to be killed")

    def detach(self) -> None:
        """Leave the subsystem; its tasks continue, and the next master finds them.

        Tasks of embedded agents end with their agents.
        """
        if self._task_set is not None:
            clients = self._task_set.clients
            self._task_set = None
            clients.drop()
            clients.client.close()
            self._end_agents()

    def finish(self) -> list[PbonetError]:
        """Turn tasks OFF in order, end them, and release the RTPUs (`sbsFinish`).

        Returns:
            An error for each task that hung and was terminated by force, and for each
            that failed in its `off` or `kill`, or died.

        Raises:
            NodeError: The subsystem is not open.
            SeveralError: Some steps failed, the others were done; if only one failed,
                its own error is raised.
        """
        self.stopped.set()
        from . import assembly

        with self.task_set.interrupts(f"turning {self.name} off", first=False):
            try:
                return assembly.end(self.task_set, self.name)
            finally:
                self.detach()

    def quit(self) -> None:
        """End the subsystem as `finish` does; warn of tasks that hung or failed.

        Raises:
            NodeError: The subsystem is not open.
            SeveralError: Some steps failed; see `finish`.
        """
        for error in self.finish():
            self._warn(str(error))

    # -- tasks ------------------------------------------------------------------------

    def spawn(
        self,
        rmod: str,
        rtpu: str | None = None,
        hz: float | None = None,
        *,
        keep: bool = False,
    ) -> m.TaskStatus:
        """Create a task from an RMOD; it is OFF when this returns (section 4.5.2).

        Args:
            rmod: The RMOD's name; it is also the name of the task.
            rtpu: The RTPU; None: as the RMOD says, else the first one that has the
                devices it opens, else the first one.
            hz: Frequency, Hz; None: as the RMOD says.
            keep: Leave a task of that name as it is, if it was made from the same RMOD
                on the same RTPU and is not in ERROR.

        Returns:
            The status of the new task, or of the one that was left.

        Raises:
            ConfigError: The RMOD does not exist, or its file is wrong.
            StateError: The subsystem has a task of this name.
            ParameterError: `hz` is not a valid frequency.
            ClaimError: The subsystem is open for reading only.
            VerificationError: The task does not fit the table or its module.
            PbonetError: The module does not load, or its `init` failed.
        """
        from . import assembly

        if hz is not None:
            check_rate(rmod, hz)
        with self._changing() as task_set:
            member = task_set.plan(self.files.rmod(rmod, hz), rtpu, hz)
            if keep and assembly.stands(task_set, member):
                return self.status(member.name)
            task_set.must_be_new(member)
            task_set.judge(legality.spawn(member.task))
            try:
                constants.at_hand(task_set, member)
                status = task_set.create(member)
                constants.given(task_set, member.name)
                return status
            finally:
                task_set.settle()

    def control(self, task: str, signal: str, arg: str = "") -> m.TaskStatus:
        """Send ``on off kill clear reinit`` to a task (section 4.5.3).

        An ``on`` is verified first: it may not make two tasks write one variable. It
        may leave inputs without a producer, because a control loop is built task by
        task; then it warns, and the illegal-configuration flag is up until the loop is
        closed. The other signals are never refused because of legality.

        Args:
            task: The task.
            signal: The signal to send.
            arg: Text for the module, available as ``self.task.arg``.

        Returns:
            The task's status after the transition.

        Raises:
            UnknownTaskError: The task does not exist.
            StateError: The signal is unknown, or not valid in the task's state.
            ClaimError: The subsystem is open for reading only.
            VerificationError: ``on`` would make the configuration illegal.
            PbonetError: A method of the module failed.
        """
        check_signal(signal)
        rtpus = self.task_set.concerned([task])
        with self._changing(strict=signal == "on", rtpus=rtpus) as task_set:
            task_set.home(task, signal)
            if signal == "on":
                task_set.judge(legality.signal(task, signal))
            try:
                with constants.signals(task_set, [(task, signal)]):
                    return task_set.control(task, signal, arg)
            finally:
                task_set.settle()

    def freq(self, task: str, hz: float | None = None) -> float:
        """Return a task's frequency in Hz; with `hz`, set it first.

        Args:
            task: The task.
            hz: The new frequency, Hz; None: only read.

        Returns:
            The frequency, Hz.

        Raises:
            UnknownTaskError: The task does not exist.
            ClaimError: `hz` is given, and the subsystem is open for reading only.
            ParameterError: `hz` is not a valid frequency.
            VerificationError: The new rate would overload the RTPU.
        """
        if hz is None:
            return self.task_set.ask(task, m.Freq(task=task), float)
        check_rate(task, hz)
        with self._changing(rtpus=[self.task_set.locate(task)]) as task_set:
            member = task_set.model.find(task)
            task_set.judge(legality.frequency(structs.replace(member.task, freq=hz)))
            request = m.Freq(task=task, hz=hz)
            try:
                member.freq = self.clients.call(member.rtpu, request, float)
                return member.freq
            finally:
                task_set.keep()

    def get(self, task: str, param: str | None = None) -> list[m.ParamValue]:
        """Return the parameters of a task's module, or a single one.

        Args:
            task: The task.
            param: The parameter; None: all.

        Returns:
            One record per parameter, with its value, type, unit and bounds.

        Raises:
            UnknownTaskError: The task does not exist.
            ParameterError: The module has no such parameter.
        """
        request = m.Get(task=task, name=param)
        return self.task_set.ask(task, request, list[m.ParamValue])

    def set(
        self, task: str, param: str | None = None, value: object = None
    ) -> list[m.ParamValue]:
        """Change a parameter of a task between two cycles, within its bounds.

        Args:
            task: The task.
            param: The parameter; None: only read all, as `get` does.
            value: A number, a word, or a sequence of them, as in a LOCAL line; None:
                only read.

        Returns:
            The parameter after the change.

        Raises:
            UnknownTaskError: The task does not exist.
            ClaimError: The subsystem is open for reading only.
            ParameterError: The module has no such parameter, or does not accept the
                value.
        """
        if param is None or value is None:
            return self.get(task, param)
        request = m.Set(task=task, name=param, value=local_words(value))
        with self._changing(rtpus=[]) as task_set:
            return task_set.ask(task, request, list[m.ParamValue], timeout=CONTROL_TIME)

    def write(self, variable: str, value: float | Iterable[float]) -> m.VarValue:
        """Set a variable that no task writes.

        Tasks that have it as an in-const are re-initialized.

        Args:
            variable: Its name.
            value: One number per element, in the variable's unit.

        Returns:
            The variable after the change.

        Raises:
            UnknownVariableError: The table has no such variable.
            SvarOwnerError: A task writes it.
            ClaimError: The subsystem is open for reading only.
            SeveralError: Users of a constant did not accept the new value.
        """
        with self._changing(strict=False) as task_set:
            self.files.must_have(variable)
            values = [value] if isinstance(value, (int, float)) else value
            request = m.Write(name=variable, values=[float(one) for one in values])
            keeper = self.sbs.keeper
            with constants.followed(
                task_set, f"{variable} was set", {variable: keeper}
            ):
                return self.clients.call(keeper, request, m.VarValue)

    # -- signals ----------------------------------------------------------------------

    def on(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Turn on a task, or several as one list verified by its end.

        Args:
            task: The tasks, in the order in which to turn them on.
            text: Text for the module of a single task, available as ``self.task.arg``.

        Returns:
            The states of the tasks, by name.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: The signal is not valid in a task's state, or no task is named.
            ClaimError: The subsystem is open for reading only.
            VerificationError: The result would be illegal; nothing was sent.
            ReconfigError: One of several tasks failed.
            PbonetError: A method of the module failed.
        """
        return self._signal("on", task, text)

    def off(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Turn off a task, or several in order; never refused because of legality.

        Args:
            task: The tasks, in the order in which to turn them off.
            text: Text for the module of a single task, available as ``self.task.arg``.

        Returns:
            The states of the tasks, by name.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: The signal is not valid in a task's state, or no task is named.
            ClaimError: The subsystem is open for reading only.
            ReconfigError: One of several tasks failed.
            PbonetError: A method of the module failed.
        """
        return self._signal("off", task, text)

    def kill(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Destroy tasks; a task that is ON is turned off first.

        Args:
            task: The tasks, in order.
            text: Text for the module of a single task, available as ``self.task.arg``.

        Returns:
            The last states of the tasks, by name.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: No task is named, or a text is given for several tasks.
            ClaimError: The subsystem is open for reading only.
            ReconfigError: One of several tasks failed.
            PbonetError: A method of the module failed; the task has ended nevertheless.
        """
        return self._signal("kill", task, text)

    def clear(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Bring tasks out of ERROR; they are OFF then.

        Args:
            task: The tasks, in order.
            text: Text for the module of a single task, available as ``self.task.arg``.

        Returns:
            The states of the tasks, by name; ERROR if the cause persists.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: A task is not in ERROR, or no task is named.
            ClaimError: The subsystem is open for reading only.
            ReconfigError: One of several tasks failed.
            PbonetError: A method of the module failed.
        """
        return self._signal("clear", task, text)

    def reinit(self, task: str | Iterable[str], *, text: str = "") -> dict[str, str]:
        """Make tasks read their constants again, without turning them off.

        Args:
            task: The tasks, in order.
            text: Text for the module of a single task, available as ``self.task.arg``.

        Returns:
            The states of the tasks, by name.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: The signal is not valid in a task's state, or no task is named.
            ClaimError: The subsystem is open for reading only.
            ReconfigError: One of several tasks failed.
            PbonetError: A method of the module failed.
        """
        return self._signal("reinit", task, text)

    def _signal(
        self, signal: str, task: str | Iterable[str], text: str
    ) -> dict[str, str]:
        tasks = names_of(task)
        if len(tasks) == 1:
            return {tasks[0]: self.control(tasks[0], signal, text).state}
        if not tasks or text:
            raise StateError(
                "a text goes to one task" if text else "no task is named",
                expected=f"{signal} TASK text=..." if text else f"{signal} TASK ...",
                got=f"{len(tasks)} tasks",
                remedy=f"give '{signal}' once for each task",
            )
        return self.reconfig([(name, signal) for name in tasks])

    def reconfig(self, item: Sequence[tuple[str, str]]) -> dict[str, str]:
        """Send an ordered list of signals, verified by its end (section 4.4.4).

        A ``kill`` of a task that has died makes the RTPU forget it; this is done before
        the list is sent.

        Args:
            item: Pairs of task and signal.

        Returns:
            The states of the tasks, by name.

        Raises:
            UnknownTaskError: A task does not exist; nothing was sent.
            StateError: A signal is unknown; nothing was sent.
            ClaimError: The subsystem is open for reading only.
            VerificationError: The result would be illegal; nothing was sent.
            ReconfigError: An item failed; it says which, and what was not sent.
        """
        items = [(task, signal) for task, signal in item]
        for _, signal in items:
            check_signal(signal)
        judged = any(signal == "on" for _, signal in items)
        with self._changing(strict=judged) as task_set:
            for task, signal in items:
                task_set.home(task, signal)
            names = task_set.model.names
            living = [item for item in items if item[0] in names]
            if judged:
                task_set.judge(legality.reconfig(living))
            try:
                dead = dict.fromkeys(task for task, _ in items if task not in names)
                states = {
                    task: task_set.control(task, "kill", "").state for task in dead
                }
                with constants.signals(task_set, living):
                    return states | task_set.send(living)
            finally:
                task_set.settle()

    def swap(
        self,
        old: str | Sequence[str],
        new: str | Sequence[str],
        *,
        rtpu: str | None = None,
        dry_run: bool = False,
    ) -> Transition:
        """Replace tasks by others while all other tasks continue (section 3.10).

        The old tasks stay OFF, so that you can swap back. Tasks named on both sides are
        not touched. Repeated after a failure, it does the rest.

        Args:
            old: The tasks that leave, by name.
            new: The tasks that come, by name; RMODs that are not tasks yet are spawned.
            rtpu: The RTPU of new tasks; None: as the RMOD says, else that of the first
                old task.
            dry_run: Only verify, and return what would be done.

        Returns:
            The signals of the change, and the tasks that are spawned, killed or
            unchanged.

        Raises:
            UnknownTaskError: An old task does not exist; nothing was done.
            StateError: A new task is in ERROR, or on another RTPU than `rtpu`; nothing
                was done.
            ClaimError: The subsystem is open for reading only.
            VerificationError: The result would be illegal; nothing was done.
            ReconfigError: A signal failed; it says which, and what was not sent.
            PbonetError: A new task could not be spawned; nothing else was done.
        """
        with self._changing(claimed=not dry_run) as task_set:
            from . import switching

            plan = switching.plan_swap(task_set, old, new, rtpu)
            self.stopped.clear()
            return switching.carry_out(
                task_set, plan, self.clock, self.stopped, dry_run=dry_run
            )

    def switch(
        self,
        job: str | Path | None = None,
        *,
        dry_run: bool = False,
        wait: float | None = None,
        abandon: bool = False,
    ) -> Transition:
        """Change to the configuration of another job; shared tasks continue (3.10).

        POST of the present job and PRE of the new one must hold, before anything is
        done and again when all tasks are spawned; they are not checked if the job is
        already present and only completed. Tasks that are ON or in ERROR and not in the
        job are turned off, and killed after the new tasks have completed a cycle. Tasks
        that are OFF stay OFF.

        Args:
            job: The ``.job`` file or its name; None: the one with which the subsystem
                was opened.
            dry_run: Only verify, and return what would be done.
            wait: Seconds in which the conditions may become true; None: they must hold
                now.
            abandon: Give the present job up: its POST is not asked, and signals sent so
                far are taken.

        Returns:
            The signals of the change, and the tasks that are spawned, killed or
            unchanged.

        Raises:
            ConfigError: The job is missing, wrong, or of another subsystem.
            StateError: A task of the job exists with other settings, or a stop came
                during the wait; nothing was done.
            ClaimError: The subsystem is open for reading only.
            VerificationError: The result would be illegal, or a condition cannot be
                evaluated; nothing was done.
            ConditionError: A condition does not hold; it has the measured values;
                nothing was done.
            ReconfigError: A signal failed, or a new task in its first cycle; it says
                which, and what was not sent.
            PbonetError: A new task could not be spawned; nothing else was done.
        """
        from .condition_gate import in_time, no_stop

        def attempt() -> Transition:
            return self.change_to(job, dry_run=dry_run, abandon=abandon, halted=halted)

        self.stopped.clear()
        halted = self._halts() if wait else no_stop
        return in_time(attempt, wait, self.clock, self.stopped, halted)

    def change_to(
        self,
        job: str | Path | None = None,
        *,
        dry_run: bool = False,
        abandon: bool = False,
        note: str = "",
        halted: Callable[[], bool] | None = None,
    ) -> Transition:
        """Change to another job as `switch` does, if its conditions hold now.

        Args:
            job: The ``.job`` file or its name.
            dry_run: Only verify, and return what would be done.
            abandon: Give the present job up.
            note: The reason of the change, for the event STEP in the log; without it
                there is no such event.
            halted: Tells whether a stop has come since the change was wanted; None:
                none can have.

        Raises:
            PbonetError: As `switch` says.
        """
        from . import switching
        from .condition_gate import ConditionGate

        with self._changing(partly=False, claimed=not dry_run) as task_set:
            if abandon and not dry_run:
                self.inbox.forget()
            wanted = self.files.read_job(job)
            gate = ConditionGate(
                task_set,
                wanted,
                leaves=True,
                abandons=abandon,
                note=note,
                halted=halted,
            )
            plan = switching.plan_job(task_set, wanted)
            return switching.carry_out(
                task_set, plan, self.clock, self.stopped, gate, dry_run=dry_run
            )

    # -- the whole --------------------------------------------------------------------

    def start(
        self, job: str | Path | None = None, *, wait: float | None = None
    ) -> list[m.TaskStatus]:
        """Start a job: verify it, spawn its tasks until all are OFF, turn them ON.

        Its PRE conditions must hold. A start that fails is undone: tasks that it turned
        on are turned off, and tasks that it spawned are killed.

        Args:
            job: The ``.job`` file or its name; None: the one with which the subsystem
                was opened.
            wait: Seconds in which PRE may become true; None: it must hold now.

        Returns:
            The status of each task of the job.

        Raises:
            ConfigError: The job is missing, wrong, or of another subsystem.
            StateError: An existing task is in the way, or a stop ended the start.
            ClaimError: The subsystem is open for reading only.
            VerificationError: It would be illegal, or a condition cannot be evaluated;
                nothing was done.
            ConditionError: A condition does not hold; it has the measured values;
                nothing was done.
            PbonetError: A step failed; the start was undone.
        """
        from . import assembly
        from .condition_gate import in_time, no_stop

        def attempt() -> list[m.TaskStatus]:
            with self._changing(partly=False) as task_set:
                wanted = self.files.read_job(job)
                self.recordings.of(wanted, self.files)
                try:
                    return assembly.start(task_set, wanted, self.stopped, halted)
                finally:
                    task_set.settle()

        self.stopped.clear()
        halted = self._halts() if wait else no_stop
        return in_time(attempt, wait, self.clock, self.stopped, halted)

    def check(self, job: str | Path | None = None) -> list[str]:
        """Verify a job, or the present tasks, without changing anything.

        Args:
            job: The ``.job`` file or its name; None: the job with which the subsystem
                was opened, else the present tasks.

        Returns:
            Warnings.

        Raises:
            ConfigError: The job is missing, wrong, or of another subsystem.
            VerificationError: The configuration is or would be illegal.
        """
        with self._busy:
            problems = self.task_set.legal(self._change(job))
            return list(map(legality.as_text, problems))

    def report(self, job: str | Path | None = None) -> list[legality.RtpuReport]:
        """Return the timing analysis of a job, or of the present tasks, legal or not.

        Args:
            job: The ``.job`` file or its name; None: as for `check`.

        Returns:
            One report per RTPU.

        Raises:
            ConfigError: The job is missing, wrong, or of another subsystem.
        """
        with self._busy:
            return self.task_set.report(self._change(job))

    def graph(self) -> configuration.Graph:
        """Return its graph: tasks, variables, wires, links to others, and faults.

        `msgspec.to_builtins` makes dictionaries and lists of it.

        Returns:
            That of the tasks as last read from the RTPUs; before `open`, that of the
            job with which it was made. Parameters have the values of the RMODs; `get`
            returns those that were set since.

        Raises:
            ConfigError: It is not open, and the job is wrong.
        """
        if self._task_set is None:
            return configuration.job_graph(self.files)
        with self._busy:
            return self.task_set.graph()

    def _change(self, job: str | Path | None) -> legality.Change | None:
        """Return the change to check; None for the present tasks."""
        self.task_set.refresh()
        if job is None and self.files.job is None:
            return None
        wanted = self.files.read_job(job)
        configuration.must_be_answerable(wanted, self.files.table.variables)
        from . import assembly

        return assembly.change(self.task_set, wanted)

    def stop(self) -> m.Stopped:
        """Turn everything OFF and end it, now, on all RTPUs at once.

        Always accepted: it needs no verification and no claim, and waits for no other
        command.

        Returns:
            The tasks that were turned off normally, and those terminated by force.

        Raises:
            SeveralError: An RTPU did not confirm; the others were stopped, and their
                agents stop it as soon as they see it again. Or a task failed in its
                `off` or `kill`; it has ended.
        """
        self.stops += 1
        self.stopped.set()
        stopped, errors, unsure = self.task_set.stop()
        self.inbox.clear()
        if self.clients.claimed and not errors:
            self.task_set.settle()
        configuration.must_be_stopped(stopped, errors, unsure)
        return stopped

    # -- looking ----------------------------------------------------------------------

    @overload
    def status(self, task: str, *, reset: bool = ...) -> m.TaskStatus: ...

    @overload
    def status(
        self, task: list[str] | tuple[str, ...] = ..., *, reset: bool = ...
    ) -> list[m.TaskStatus]: ...

    @overload
    def status(
        self,
        task: str | Sequence[str] = ...,
        *,
        fields: str | Sequence[str],
        reset: bool = ...,
    ) -> list[Profile]: ...

    def status(
        self,
        task: str | Sequence[str] = (),
        *,
        fields: str | Sequence[str] | None = None,
        reset: bool = False,
    ) -> m.TaskStatus | list[m.TaskStatus] | list[Profile]:
        """Return the status of one task, of several, or of all (`sbsStatus`).

        Args:
            task: One task, or several; none: all.
            fields: Columns of the command ``status``, ``all`` or ``default``, or an
                empty sequence for those of `status_set`. The result is then that of the
                command, with counters since the program's previous such call.
            reset: Let minC, maxC, minU and maxU begin with the next cycle of each task;
                the result has them until now. A cycle that ends at this moment may be
                missing in both.

        Returns:
            A record for one task, a list for several. Counters count from the task's
            last ``on``.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: A field does not exist.
            AccessError: An observer asks for `reset`.
            SeveralError: No RTPU answers; if there is only one RTPU, its own error is
                raised.
        """
        wanted = names_of(task)
        shown = columns(names_of(fields or ())) or self.shown
        found = [t for t in self.status_all() if not wanted or t.task in wanted]
        for name in wanted:
            self.model.find(name)
        if reset:
            found = self.task_set.restart_extremes(found)
        if fields is not None:
            return [one.only(shown) for one in self.baselines.since(found)]
        if not isinstance(task, str):
            return found
        if not found:
            raise StateError(
                "the task disappeared during the request",
                where=task,
                remedy="'status' shows which tasks there are",
            )
        return found[0]

    def status_set(self, field: str | Sequence[str] = ()) -> tuple[str, ...]:
        """Set the fields that `status` shows when it is given no fields; return them.

        Args:
            field: Names of fields, ``all`` or ``default``; none: only return the
                present ones.

        Raises:
            StateError: A field does not exist.
        """
        self.shown = columns(names_of(field)) or self.shown
        return self.shown

    def status_all(self) -> list[m.TaskStatus]:
        """Return the status of every task of the subsystem (`sbsStatusAll`).

        Raises:
            SeveralError: No RTPU answers; if there is only one RTPU, its own error is
                raised.
        """
        return [task for rtpu in self.rtpu_status() for task in rtpu.tasks]

    def rtpu_status(self) -> list[m.RtpuStatus]:
        """Return the status of every RTPU that answers, and of its tasks.

        RTPUs that do not answer cause warnings.

        Raises:
            SeveralError: No RTPU answers; if there is only one RTPU, its own error is
                raised.
        """
        return self.task_set.refresh(strict=False)

    def events_count(self, task: str | Sequence[str] = ()) -> list[dict[str, Any]]:
        """Return how often each kind of event occurred, suppressed ones included.

        Args:
            task: Only these tasks; none: all.

        Returns:
            Maps with ``rtpu``, ``task``, ``code`` and ``count``.

        Raises:
            UnknownTaskError: A task does not exist.
        """
        wanted = names_of(task)
        rtpus = self.rtpu_status()
        for name in wanted:
            self.model.find(name)
        return [
            {"rtpu": rtpu.rtpu, "task": name, "code": code, "count": count}
            for rtpu in rtpus
            for name, codes in sorted(rtpu.events.items())
            for code, count in sorted(codes.items())
            if not wanted or name in wanted
        ]

    def profile(self, task: str | Sequence[str] = ()) -> list[m.TaskProfile]:
        """Return the execution profiles of tasks (section 6.7).

        Args:
            task: The tasks; none: all.

        Raises:
            UnknownTaskError: A task does not exist.
            NodeError: The subsystem runs in virtual time, which has no execution times.
        """
        from . import profiling

        return profiling.ask(self.task_set, names_of(task))

    def profile_save(self, task: str | Sequence[str] = ()) -> list[tuple[Saved, Path]]:
        """Save profiles beside the ``.sbs`` file, for the analysis of later starts.

        Args:
            task: The tasks; none: all that have run long enough.

        Returns:
            Each saved profile with its file.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: A named task has run too few cycles.
            ConfigFileError: A file cannot be written.
        """
        from . import profiling

        return profiling.save(self.task_set, names_of(task))

    def display(
        self,
        variable: str | Iterable[str] | None = None,
        *,
        task: str | None = None,
        writer: str | None = None,
    ) -> list[m.VarValue]:
        """Return values of variables with their age, writer and unit.

        All values are of one instant, unless a value's ``whole`` says that this is not
        proven.

        Args:
            variable: Names, in which * and ? match any text; None: all.
            task: Only variables of this task's ports.
            writer: Only variables that this task writes now.

        Raises:
            UnknownVariableError: The table has no such variable.
            UnknownTaskError: The task does not exist.
        """
        known = [one.name for one in self.files.table.variables]
        patterns = names_of(variable or ())
        names = matching(patterns, known) if patterns else known
        if task:
            ports = self.model.find(task).variables
            names = [name for name in names if name in ports]
        if not names:
            return []
        request = m.Display(names=names)
        keeper = self.files.sbs.keeper
        values = self.clients.call(keeper, request, list[m.VarValue])
        values.sort(key=lambda one: names.index(one.name))
        return [one for one in values if writer in {None, task_of(one.writer)}]

    def values(
        self, variable: str | Iterable[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return values of variables as numpy arrays, all of one instant.

        Args:
            variable: Names, in which * and ? match any text; None: all.

        Returns:
            By name, each with the type of the table: shape ``(n,)``, or ``()`` of a
            variable with one element. `display` also has unit, age and writer.

        Raises:
            UnknownVariableError: The table has no such variable.
        """
        from .variable_arrays import array_of

        table = {one.name: one for one in self.files.table.variables}
        found = self.display(variable)
        return {one.name: array_of(one.values, table[one.name]) for one in found}

    def value(self, variable: str) -> NDArray[Any]:
        """Return the value of one variable as a numpy array, as `values` does.

        Raises:
            UnknownVariableError: The table has no such variable.
        """
        self.files.must_have(variable)
        return self.values(variable)[variable]

    def _repr_html_(self) -> str:
        """Return what a notebook shows: a table of the tasks, and their graph.

        What cannot be read is said in its place: a notebook would show a stack.
        """
        from . import subsystem_html

        try:
            statuses = self.status_all() if self.is_open else None
            return subsystem_html.page(self.graph(), statuses)
        except PbonetError as error:
            return subsystem_html.failed(self.name, error)

    def library(
        self,
        text: str | Sequence[str] = (),
        *,
        class_: str | None = None,
        in_: str | None = None,
        out: str | None = None,
        unit: str | None = None,
    ) -> list[Found]:
        """Return modules in the agents' libraries, by class and name.

        Args:
            text: The name of one module, or words that its description has.
            class_: Its class, or the beginning of it (Stewart 1994, Figure 3.14).
            in_: A variable that it reads; * and ? match any text.
            out: A variable that it writes.
            unit: The unit of such a port, or of any.

        Raises:
            ModuleLoadError: There is no such module.
            ConfigError: There is no such class.
        """
        wanted = Search(
            text=tuple(names_of(text)),
            class_=class_ or "",
            in_=in_ or "",
            out=out or "",
            unit=unit or "",
        )
        infos = remote_modules.of(self.clients)
        return search(infos, self.files.library.records(), wanted)

    # -- signals and events of tasks ---------------------------------------------------

    def sigwait(
        self,
        signal: str | Sequence[str] = (),
        *,
        task: str | Sequence[str] = (),
        timeout: float | None = None,
    ) -> Sent:
        """Wait until a task has sent one of some signals, and take it (`sbsSigWait`).

        A signal that was sent before and not taken is returned at once. Other signals
        stay pending until they are waited for; to discard them, mask them.

        Args:
            signal: Names, such as ``FINISH`` or one that a module declares; none: any.
            task: Only signals of these tasks; none: of any task.
            timeout: Seconds; None: wait without a limit.

        Returns:
            The signal, the task that sent it, and how often it did.

        Raises:
            UnknownTaskError: A task does not exist.
            StateError: No task has such a signal, or the subsystem was stopped.
            NoAnswerError: The timeout expired.
        """
        check_time(timeout)
        signals, tasks = names_of(signal), names_of(task)
        self.stopped.clear()
        deadline = None if timeout is None else self.clock.now() + timeout
        with self.news() as news:
            statuses = self.status_all()
            task_signal_inbox.must_be_known(
                signals, tasks, statuses, self.model, self.name
            )
            while True:
                if sent := self.inbox.take(statuses, signals, tasks):
                    return sent
                left = (
                    task_signal_inbox.LOOK_TIME
                    if deadline is None
                    else deadline - self.clock.now()
                )
                if left <= 0:
                    raise self._too_late(signals, tasks, timeout or 0.0)
                self.clock.wait(min(left, task_signal_inbox.LOOK_TIME), news)
                news.clear()
                self._must_go_on()
                statuses = self.status_all()

    def until(
        self,
        end: str | Sequence[str] = (),
        *,
        seconds: float | None = None,
        timeout: float | None = None,
    ) -> str:
        """Wait until a step of a program has ended, and take the signals sent so far.

        What is sent from then on counts for the next step. A task that sends ERROR or
        SHUTDOWN ends the wait with an error, unless a fallback takes its place, or
        that signal is waited for.

        Args:
            end: What ends it, as after UNTIL in a ``.seq`` file: signals, such as
                ``FINISH`` or ``jaws CLOSED``, and conditions in parentheses.
            seconds: It ends after so many seconds in any case; None: not by itself.
            timeout: Seconds after which it has failed; None: wait without a limit.

        Returns:
            Which of the ends it was; empty if the `seconds` are over.

        Raises:
            ConfigError: An end is neither a signal nor a condition.
            VerificationError: A condition cannot be evaluated.
            UnknownTaskError: A task does not exist.
            StateError: A task failed, no task has such a signal, or the subsystem was
                stopped.
            NoAnswerError: The timeout expired.
        """
        from . import step_end

        ends = [step_end.parsed(one) for one in names_of(end)]
        self.stopped.clear()
        found = self.step_ends.wait(
            ends, seconds=seconds, timeout=timeout, look=self._must_go_on
        )
        return str(found or "")

    def holds(self, condition: str) -> bool:
        """Return whether a condition holds now, as those of jobs are judged.

        Args:
            condition: As after PRE in a ``.job`` file.

        Raises:
            ConfigError: It is not a condition.
            VerificationError: It cannot be evaluated.
        """
        from . import step_end

        return self.step_ends.holds(step_end.parsed(f"({condition})"))

    @property
    def step_ends(self) -> StepEnds:
        """The waits for the ends of steps."""
        from .step_end import StepEnds

        return StepEnds(self.task_set, self.inbox, self.clock)

    def news(self) -> AbstractContextManager[threading.Event]:
        """Return a context in which an event is set whenever an RTPU publishes one."""
        return task_signal_inbox.wake_on_events(self.clients)

    def signals(self) -> list[Sent]:
        """Return the pending signals, without taking them."""
        return self.inbox.pending(self.status_all())

    def sigmask(
        self, signal: str | Sequence[str] | None = None, task: str | None = None
    ) -> dict[str, list[str]]:
        """Get or set the signals to ignore; masked signals are not even counted.

        A task without its own mask uses that of the subsystem.

        Args:
            signal: Names; ``none`` is a mask that ignores no signal, ``unset`` removes
                the mask. None: only read.
            task: The task with the mask; None: the subsystem.

        Returns:
            The masks that are set, by task; ``""`` is the subsystem's.

        Raises:
            UnknownTaskError: The task does not exist.
            StateError: No task has such a signal.
            ClaimError: The subsystem is open for reading only.
            SeveralError: RTPUs did not accept the mask.
        """
        signals = None if signal is None else names_of(signal)
        tasks = [] if task is None else [task]
        names = [] if signals in (["none"], ["unset"]) else list(signals or ())
        if signals is not None:
            self.clients.must_be_claimed()
        task_signal_inbox.must_be_known(
            names, tasks, self.status_all(), self.model, self.name
        )
        request = m.Sigmask(
            task=task or "",
            names=None if signals is None else names,
            unset=signals == ["unset"],
        )
        if task is not None and signals is not None:
            self.clients.call(self.task_set.locate(task), request, dict[str, list[str]])
            request = m.Sigmask()
        found, errors = self.clients.each(lambda _: request, dict[str, list[str]])
        rpc.raise_all(f"{len(errors)} RTPUs do not take a signal mask", errors)
        return {key: mask for masks in found.values() for key, mask in masks.items()}

    def events(
        self,
        last: int | None = None,
        *,
        since: int | str = 0,
        task: str | None = None,
        code: str | None = None,
        severity: str | None = None,
    ) -> list[m.Event]:
        """Return events of the RTPUs that concern the subsystem, oldest first.

        RTPUs that do not answer cause warnings.

        Args:
            last: At most this many, the newest; None: all that the RTPUs have kept.
            since: Number of the first event wanted of each RTPU, or an age, such as
                ``5m``.
            task: Only events of this task.
            code: Only this code, such as ``WARNING``.
            severity: The least severity, ``debug`` to ``fatal``.

        Raises:
            StateError: The severity does not exist, or `since` is neither a number nor
                an age.
            UnknownTaskError: The task does not exist and has no events.
            SeveralError: No RTPU reports its events; if there is only one RTPU, its own
                error is raised.
        """
        given = {"task": task, "code": code, "severity": severity, "since": since}
        from . import event_filter

        wanted, first = event_filter.EventFilter.of(given), event_filter.since(since)[0]
        request = m.Events
        results, errors = self.clients.each(
            lambda _: request(since=first), list[m.Event]
        )
        if not results:
            rpc.raise_all(f"{len(errors)} RTPUs do not report their events", errors)
        self.task_set.warn(map(str, errors))
        found = [event for events in results.values() for event in events]
        if doubt := wanted.doubt(found):
            self._warn(doubt)
        mine = [event for event in found if event.subsystem in {"", self.name}]
        if task is not None and not any(event.task == task for event in mine):
            self.task_set.locate(task)  # one that has ended may have events
        chosen = sorted(filter(wanted, mine), key=lambda event: (event.wall, event.n))
        return chosen if last is None else chosen[max(0, len(chosen) - last) :]

    # -- this program -----------------------------------------------------------------

    def wait(self, seconds: float) -> bool:
        """Wait; a stop ends the wait. Return whether the time is over.

        Args:
            seconds: The time to wait.

        Raises:
            StateError: `seconds` is not a valid time.
        """
        check_time(seconds)
        self.stopped.clear()
        return not self.clock.wait(seconds, self.stopped)

    # -- how --------------------------------------------------------------------------

    def _must_go_on(self) -> None:
        if self.stopped.is_set():
            raise StateError(
                "the subsystem was stopped during the wait for a signal",
                where=self.name,
                remedy="start it, then wait again",
            )

    def _too_late(
        self, signals: Sequence[str], tasks: Sequence[str], timeout: float
    ) -> NoAnswerError:
        others = self.signals()
        return NoAnswerError(
            f"no signal {' or '.join(signals) or 'at all'} within {timeout:g} s",
            where=", ".join(tasks) or self.name,
            got="pending: "
            + (", ".join(f"{one.task} {one.signal}" for one in others) or "nothing"),
            remedy="'status' shows the state of the tasks",
        )

    def _warn(self, text: str) -> None:
        """Pass a warning to the command that caused it, else to `warned`."""
        (collector() or self.warned)(text)

    def _halts(self) -> Callable[[], bool]:
        """Return what tells whether a stop from elsewhere ended the tasks since now."""
        begin = {order for one in self.clients.infos() for order in one.stops}

        def halted() -> bool:
            infos = self.clients.infos()
            on = any(one.on.get(self.name) for one in infos)
            return not on and any(not begin.issuperset(one.stops) for one in infos)

        return halted

    def _changing(
        self,
        *,
        strict: bool = True,
        partly: bool = True,
        claimed: bool = True,
        rtpus: Sequence[str] | None = None,
    ) -> ChangeTransaction:
        return ChangeTransaction(
            self.task_set,
            self._busy,
            strict=strict,
            partly=partly,
            claimed=claimed,
            rtpus=rtpus,
        )
