"""The tasks of an open subsystem, and the steps that commands are made of.

Everything that changes a task goes through here and keeps the task model up to date, so
that the next verification uses the real state, not the requested one.
"""

from __future__ import annotations

import os
from functools import cache, partial
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec import structs

from pbonet import config
from pbonet.analysis import legality, schedule
from pbonet.errors import (
    NoAnswerError,
    PbonetError,
    UnknownTaskError,
    UnreachableError,
)
from pbonet.lazy import logger
from pbonet.master import configuration
from pbonet.pbo import State
from pbonet.xm.net import convert, messages as m, rpc

from . import remote_modules, send_signal_list, warning_dedup
from .call_in_thread import InThread
from .standbys import Standbys
from .unwritten_inputs import UnwrittenInputs
from .warning_dedup import WarningDedup

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from pbonet.config import Rmod
    from pbonet.master.configuration import Files, Member, RmodSource, TaskModel
    from pbonet.pbo import ModuleInfo

    from .interrupt_signals import InterruptsInTurn
    from .recording_control import RecordingControl
    from .rtpu_clients import RtpuClients
    from .task_signal_inbox import Inbox

    Warned = Callable[[str], None]
    Problems = Sequence[legality.Problem]

CONTROL_TIME = 5.0
"""Seconds for a signal; `MOST_EXTRA` more if the task's core is busy."""
SPAWN_TIME = 10.0
"""Seconds for `init`; `MOST_EXTRA` more if the task's core is busy."""
KILL_AGAIN_TIME = 0.1
"""Seconds between two kills of tasks that are being created."""
_LONGEST_SPAWN = (1.0 + m.MOST_EXTRA) * SPAWN_TIME + 1.0
STOP_TIME = 2.0
"""Seconds for a stop, however busy cores are."""
SIGNALS = {
    "on": State.ON,
    "off": State.OFF,
    "kill": State.NOT_CREATED,
    "clear": State.OFF,
    "reinit": None,
}
"""Signals to a task, and the state that each leads to; None: as before."""

T = TypeVar("T")
_UNHEARD = (UnreachableError, NoAnswerError)


class SubsystemTasks:
    """The tasks of a subsystem and their RTPUs.

    Args:
        files: The subsystem's files.
        fleet: Its RTPUs.
        warned: Called with each warning.
        logbook: Has the run recorded.
        inbox: Hears what tasks have sent.
        virtual: Whether tasks run in this process, with the library of the files.
    """

    def __init__(
        self,
        files: Files,
        clients: RtpuClients,
        warned: Warned,
        recordings: RecordingControl,
        inbox: Inbox,
        *,
        virtual: bool = False,
    ) -> None:
        self.files = files
        self.clients = clients
        self.warned = warned
        self.recordings = recordings
        self._inbox = inbox
        self._virtual = virtual
        self._model = configuration.TaskModel()
        self._unread: dict[str, m.TaskStatus] = {}
        """Of tasks that are not in the model yet, for their files are not read."""
        self._info = cache(partial(remote_modules.on, clients, files.library))
        self._standing = WarningDedup()
        self._unwritten = UnwrittenInputs(
            lambda flag: clients.call(files.sbs.keeper, flag, list[str]), self.say
        )
        self._noted: set[str] = set()  # reported already, of saved profiles
        self._modules: dict[str, Any] = {}  # that tasks run, as claims describe them
        self._fresh: dict[str, m.RtpuStatus] = {}  # for the next `refresh`
        self._producers = files.producers()  # of the library as the command found it
        self.accepted: Collection[legality.Code] = ()
        """Problems for which no change is refused."""
        self._whole = False  # the tasks of every RTPU are known
        self.partly = False
        """Whether a judgement may rest on the RTPUs that answer."""
        self._missing: set[str] = set()
        """RTPUs that do not answer: judgements leave their tasks out."""
        self.silent: dict[str, PbonetError] = {}
        """The errors of the RTPUs that did not give their status when asked last."""
        self._priorities: dict[str, int] = {}  # as the RTPUs have them
        self.standbys = Standbys(lambda: self.model, clients, self.note, warned)

    # -- the task model ----------------------------------------------------------------

    @property
    def model(self) -> TaskModel:
        """The tasks as last seen; files of new ones are read when it is asked for."""
        for task, status in list(self._unread.items()):
            self._update(status)
            self._unread.pop(task, None)
        return self._model

    def take(
        self,
        *,
        take_over: bool,
        partly: bool,
        task: str = "",
        confirm: Callable[[str], bool] | None = None,
    ) -> None:
        """Claim the RTPUs, open the table, and take in the existing tasks there.

        Args:
            take_over: Replace a master that lives; then every RTPU is claimed.
            partly: Be content with the RTPUs that answer, and warn of the others.
            task: Claim only the RTPU of this task, if the task is where its files say.
            confirm: Asked before tasks that are CRITICAL and ON are taken over.

        Raises:
            ClaimError: An RTPU belongs to another subsystem or another master.
            SvarError: The table cannot be opened; the claims were given back.
            SeveralError: Several RTPUs cannot be had.
        """
        if task and not take_over and self._take_home(task):
            return
        others = [
            name for name in self.clients.names if name not in self.clients.epochs
        ]
        claims, errors = self._claim(
            others, take_over=take_over, partly=partly, confirm=confirm
        )
        self.warn(map(str, errors))
        self._take_in(claims)

    def _take_home(self, task: str) -> bool:
        """Claim the RTPU that a task should be on; return whether it is there."""
        try:
            claims, _ = self._claim([self.files.likely_rtpu(task)])
        except (UnreachableError, NoAnswerError):  # the task may be on another one
            return False
        self._take_in(claims)
        return task in self.model

    def _claim(
        self,
        rtpus: list[str],
        *,
        take_over: bool = False,
        partly: bool = False,
        confirm: Callable[[str], bool] | None = None,
    ) -> tuple[dict[str, m.Claimed], list[PbonetError]]:
        return self.clients.claim(
            rtpus,
            svar=self.files.table_text,
            svar_name=self.files.table.file,
            take_over=take_over,
            confirm=confirm,
            partly=partly or self.clients.claimed,
        )

    def _take_in(self, claims: dict[str, m.Claimed]) -> None:
        """Take in the existing tasks on RTPUs that were claimed."""
        for rtpu, claimed in claims.items():
            for task in claimed.tasks:
                source = self._source(task, claimed.rmods.get(task))
                freq = source.record.freq or 0.0
                self.model.add(
                    configuration.Member(source=source, rtpu=rtpu, freq=freq)
                )
            self._modules |= claimed.modules
            if claimed.status is not None:
                self._fresh[rtpu] = claimed.status

    def ask(
        self,
        task: str,
        request: m.Request,
        result: type[T],
        *,
        timeout: float = rpc.ANSWER_TIME,
    ) -> T:
        """Send a request about one task to its RTPU, and return the result.

        Where the task is not known it is asked for where its files say. The other RTPUs
        are asked only if it is not there.

        Raises:
            UnknownTaskError: There is no such task.
            PbonetError: As `rpc.Client.call` and the agent say.
        """
        member = self.model.get(task)
        if member is None and self._whole:
            return self.clients.call(
                self.locate(task), request, result, timeout=timeout
            )
        rtpu = member.rtpu if member else self.files.likely_rtpu(task)
        try:
            return self.clients.call(rtpu, request, result, timeout=timeout)
        except (UnknownTaskError, UnreachableError, NoAnswerError):
            self.refresh(strict=False)
            home = self.model.find(task).rtpu
            if home == rtpu:
                raise
        return self.clients.call(home, request, result, timeout=timeout)

    def concerned(self, tasks: Sequence[str]) -> list[str]:
        """Return the RTPUs that a change of some tasks can make illegal.

        They are those that the tasks are on, and those with tasks that share a variable
        with them. If a task is not known or gives constants, all are.
        """
        members = [self.model.get(task) for task in tasks]
        known = [member for member in members if member is not None]
        if len(known) < len(members) or any(one.task.gives for one in known):
            return self.clients.names
        shared = {name for member in known for name in member.variables}
        homes = {one.rtpu for one in self.model if one.variables & shared}
        homes |= {member.rtpu for member in known}
        return [name for name in self.clients.names if name in homes]

    def reuse(self, statuses: Iterable[m.RtpuStatus]) -> None:
        """Have the next `refresh` take these statuses, and ask for no newer ones."""
        self._fresh |= {status.rtpu: status for status in statuses}

    def refresh(
        self, *, strict: bool = True, rtpus: Sequence[str] | None = None
    ) -> list[m.RtpuStatus]:
        """Ask the RTPUs how the tasks stand now; return their status.

        Those that were claimed just now have given it with the claim.

        Args:
            strict: Whether a judgement is to rest on it. Then every RTPU must answer,
                or with `partly` the tasks of those that do not are left out of it. Else
                these are only reported, as warnings. Their tasks stay in the model as
                they were last seen.
            rtpus: Which are asked; None: all.

        Raises:
            SeveralError: Several agents do not answer; of one, its own error.
        """
        self._producers = self.files.producers()
        known, dead = {*self._model.names, *self._unread}, self._inbox.dead()
        wanted = self.clients.names if rtpus is None else rtpus
        results = {name: self._fresh[name] for name in wanted if name in self._fresh}
        self._fresh.clear()
        asked = [name for name in wanted if name not in results]
        found, errors = self.clients.each(
            lambda _: m.Status(), m.RtpuStatus, rtpus=asked
        )
        results |= found
        failed = [name for name in asked if name not in found]
        self.silent = dict(zip(failed, errors, strict=True))
        missing = [name for name in wanted if name not in results]
        survive = self.partly and all(isinstance(one, _UNHEARD) for one in errors)
        if not results or (strict and not survive):
            rpc.raise_all(f"{len(errors)} RTPUs do not give their status", errors)
        self.warn(map(str, errors))
        self._missing = (self._missing - results.keys()) | {*missing}
        if len(wanted) == len(self.clients.names):
            self._whole = not missing
        if strict:
            self.warn(map(self._without, missing))
        statuses = [results[name] for name in self.clients.names if name in results]
        there = [task for rtpu in statuses for task in rtpu.tasks]
        for status in there:
            self.note(status)
        names = {status.task for status in there}
        self._inbox.bury({t for t, rtpu in dead.items() if rtpu in results} - names)
        for name in known - names:  # others were spawned meanwhile
            member = self.model.get(name)
            if member is not None and member.rtpu in results:
                self.model.remove(name)
        if self.clients.sbs.keeper in results:
            self._unwritten.seen(cause for rtpu in statuses for cause in rtpu.illegal)
        return statuses

    def _without(self, rtpu: str) -> str:
        """Return the warning for an RTPU whose tasks are left out of a judgement."""
        names = [member.name for member in self.model if member.rtpu == rtpu]
        there = f", where {' '.join(names)} was seen last" if names else ""
        return (
            f"judged without {rtpu}{there}: whether tasks there write the inputs of "
            "others, or the same outputs, is not known"
        )

    @property
    def reached(self) -> list[Member]:
        """The tasks of the RTPUs that answer."""
        return [one for one in self.model if one.rtpu not in self._missing]

    def restart_extremes(self, tasks: Iterable[m.TaskStatus]) -> list[m.TaskStatus]:
        """Restart the extremes of CPU time; return the status that has them until now.

        Raises:
            AccessError: An observer asks for it.
            PbonetError: As `rpc.Client.call` and the agent say.
        """
        found: list[m.TaskStatus] = []
        for task in tasks:
            request = m.Status(task=task.task, reset=True)
            found += self.clients.call(task.rtpu, request, m.RtpuStatus).tasks
        return found

    def note(self, status: m.TaskStatus) -> None:
        """Enter a task's status and signals into the task model."""
        self._inbox.note(status)
        self._priorities[status.task] = status.priority
        if status.task in self._model:
            self._update(status)
        else:
            self._unread[status.task] = status

    def _update(self, status: m.TaskStatus) -> None:
        """Take a task's status into the model."""
        member = self._model.get(status.task)
        if member is None:
            try:
                source = self._source(status.rmod, None)
            except PbonetError as error:  # spawned from elsewhere; it is only watched
                logger("pbonet.master").debug("task %s: %s", status.task, error)
                return
            member = configuration.Member(
                source=source, rtpu=status.rtpu, freq=status.ref_f
            )
            self._model.add(member)
        member.rtpu, member.freq = status.rtpu, status.ref_f
        member.restart = status.restart
        if status.fallback_of:
            member.fallback_of = status.fallback_of
            member.original_rtpu = status.original_rtpu
            member.takeover = status.takeover
        self._model.move(status.task, State(status.state))

    def recall(self, task: str, rtpu: str) -> None:
        """Enter a task that was lost into the model, as it was seen by others."""
        source = self._source(task, None)
        state = State.ON if rtpu in self._missing else State.NOT_CREATED
        freq = source.record.freq or 0.0
        self.model.add(
            configuration.Member(source=source, rtpu=rtpu, freq=freq, state=state)
        )

    def locate(self, task: str) -> str:
        """Return the RTPU of a task, asking the agents when it is not known.

        Raises:
            UnknownTaskError: There is no such task.
        """
        member = self.model.get(task)
        if member is None:
            self.refresh(strict=False)
            member = self.model.find(task)
        return member.rtpu

    def _source(self, task: str, text: str | None) -> RmodSource:
        """Return the RMOD from which a task was spawned, else that of its file."""
        if text:
            record = config.parse_rmod(text, f"{task}.rmod")
            return configuration.RmodSource(record, text)
        return self.files.rmod(task)

    # -- judging ----------------------------------------------------------------------

    def info(self, rtpu: str, rmod: Rmod) -> ModuleInfo:
        """Return the description of an RMOD's module in the RTPU's library.

        Raises:
            ModuleLoadError: The library has no such module, or it does not load.
        """
        if self._virtual:
            return self.files.library.load_rmod(rmod).info
        return config.info_of(rmod, partial(self._info, rtpu))

    def plan(self, source: RmodSource, rtpu: str | None, freq: float | None) -> Member:
        """Return the task that an RMOD would become.

        Without an RTPU it goes to the one that has the devices that it opens, else to
        the first one.

        Raises:
            NodeError: The subsystem has no such RTPU.
            ModuleLoadError: The agent there has no such module, or it does not load.
        """
        where = rtpu or source.record.rtpu or self._home(source.record)
        self.clients.entry(where)
        member = configuration.Member(
            source=source, rtpu=where, freq=freq or source.record.freq or 0.0
        )
        self._describe(member)
        return member

    def _home(self, rmod: Rmod) -> str:
        """Return the RTPU for a task that no file gives one."""
        first, *others = self.clients.names
        if not others:
            return first
        wanted = legality.named_things(rmod, self.info(first, rmod))
        names = self._names() if wanted else {}
        return legality.only_home(wanted, [first, *others], names) or first

    def _names(self) -> dict[str, dict[str, list[str]]]:
        """Return what tasks can open by name on each RTPU, asked now: by kind."""
        return {info.name: info.names for info in self.clients.infos()}

    def _describe(self, member: Member) -> None:
        """Get the description of a task's module, and the task's saved profile.

        Raises:
            ModuleLoadError: The agent there has no such module, or it does not load.
        """
        member.info = member.info or self.info(member.rtpu, member.rmod)
        store = self.files.profiles
        if store.hosts(member.name):
            host = self.clients.agent(member.rtpu).host
            member.saved, note = store.find(member.rmod, host, member.info)
            if note and note not in self._noted:
                self._noted.add(note)
                self.warned(note)

    def must_be_new(self, member: Member) -> None:
        """Refuse to spawn a task twice.

        Raises:
            StateError: The subsystem has a task of this name.
        """
        old = self.model.get(member.name)
        if old is not None:
            raise configuration.already(old)

    def judge(self, change: legality.Change) -> None:
        """Refuse a change that would be illegal; else report its new warnings.

        Raises:
            VerificationError: It would be illegal.
            UnreachableError: It turns a task of an RTPU on that does not answer.
        """
        self.say(self.legal(change))

    def legal(self, change: legality.Change | None = None) -> Problems:
        """Return the warnings for a change, or for the present tasks.

        Raises:
            VerificationError: It would be, or is, illegal.
            UnreachableError: It turns a task of an RTPU on that does not answer.
        """
        self.with_infos(self.reached)
        problems = self._problems(change and self._of_reached(change))
        refused = warning_dedup.refused(problems)
        if refused := [one for one in refused if one.code not in self.accepted]:
            raise legality.as_error(refused)
        return problems

    def _of_reached(self, change: legality.Change) -> legality.Change:
        """Return the part of a change that concerns the RTPUs that answer."""
        items: list[tuple[str, str]] = []
        for task, signal in change.items:
            member = self.model.get(task)
            if member is None or member.rtpu not in self._missing:
                items.append((task, signal))
            elif signal == "on" and not member.is_on:
                raise UnreachableError(
                    f"the task {task} is on an RTPU that does not answer",
                    where=f"{member.rtpu}/{task}",
                    remedy="see why with 'pbonet doctor'; tasks of other RTPUs can be "
                    "changed",
                )
        return structs.replace(change, items=tuple(items))

    def _problems(self, change: legality.Change | None = None) -> Problems:
        now = self.configuration()
        coming = change.tasks if change else ()
        if any(legality.named_things(task.rmod, task.info) for task in coming):
            now = structs.replace(now, names=self._names())
        found = legality.judge(now, change).problems if change else legality.check(now)
        if self._whole:
            return found
        by_others = {legality.Code.NO_WRITER, legality.Code.NO_CONSTANT}
        return [one for one in found if one.code not in by_others]

    def report(
        self, change: legality.Change | None = None
    ) -> list[legality.RtpuReport]:
        """Return the analysis of a change, or of the present configuration.

        Raises:
            ModuleLoadError: A task's module is not there any more.
        """
        self.with_infos(self.reached)
        now = self.configuration()
        return legality.report(legality.judge(now, change).after if change else now)

    def graph(self) -> configuration.Graph:
        """Return the graph of the present tasks, and what verification says of them.

        A task has ports as its RMOD says if its module is not there any more, or its
        RTPU does not answer.
        """
        self._producers = self.files.producers()
        faults: list[configuration.GraphFault] = []
        for member in self.reached:
            try:
                self.with_infos([member])
            except PbonetError as error:
                faults.append(configuration.unread(str(error), member.name))
        tasks = [member.task for member in self.model]
        return configuration.graph_of(self.files, tasks, self._problems(), faults)

    def configuration(self) -> legality.Configuration:
        """Return the present subsystem."""
        return legality.Configuration(
            svar=self.files.table,
            tasks=tuple(member.task for member in self.reached),
            on=frozenset(member.name for member in self.reached if member.is_on),
            rtpus=self.files.sbs.rtpus,
            machines=self.clients.machines(),
            keeper=self.files.sbs.keeper,
            alone=self.files.sbs.alone,
            strict=self.files.sbs.strict,
            producers=self._producers if self._whole else {},
            core=schedule.ASSUMED,
            cores=self.clients.core_shares(),
            copy_speeds=self.clients.copy_speeds(),
        )

    def with_infos(self, members: Iterable[Member]) -> None:
        """Get the description of each task's module, where it is not known yet."""
        for member in members:
            if member.info is None:
                if described := self._modules.pop(member.name, None):
                    from pbonet.pbo import ModuleInfo  # it is loaded with numpy

                    member.info = convert(described, ModuleInfo)
                self._describe(member)

    def say(self, problems: Problems) -> None:
        """Report warnings that were not reported yet; `settle` follows."""
        self.warn(self._standing.say(problems))

    def warn(self, warnings: Iterable[str]) -> None:
        """Hand on warnings."""
        for text in warnings:
            self.warned(text)

    def create(self, member: Member, replaces: Sequence[str] = ()) -> m.TaskStatus:
        """Spawn one task and enter it into the task model.

        Args:
            member: The task.
            replaces: Tasks that leave, whose constants it takes over.

        Raises:
            PbonetError: It could not be created; nothing of it stays.
        """
        request = self._spawn_request(member, self.priorities([*self.model, member]))
        request.replaces = list(replaces)
        self._record_first()
        found, errors = self._spawned({member.rtpu: request})
        rpc.raise_all(f"{member.name} could not be created", errors)
        self._created(member, found[member.rtpu])
        return found[member.rtpu]

    def create_all(
        self, members: Sequence[Member]
    ) -> tuple[list[str], list[PbonetError]]:
        """Spawn tasks at once, each on an RTPU of its own; enter them into the model.

        Returns:
            The names of those that were created, and the errors of the others.
        """
        if not members:
            return [], []
        priorities = self.priorities([*self.model, *members])
        requests = {one.rtpu: self._spawn_request(one, priorities) for one in members}
        self._record_first()
        found, errors = self._spawned(requests)
        created = [one for one in members if one.rtpu in found]
        for one in created:
            self._created(one, found[one.rtpu])
        return [one.name for one in created], errors

    def _spawn_request(self, member: Member, priorities: Mapping[str, int]) -> m.Spawn:
        soft = legality.effective(member.task)
        return m.Spawn(
            task=member.name,
            rmod=member.source.text,
            rmod_name=_place(member.rmod),
            freq=member.freq or None,
            crit=member.rmod.crit,
            priority=priorities[member.name],
            effc=soft.seconds if soft else None,
            timeout=SPAWN_TIME,
            restart=member.restart,
        )

    def _spawned(
        self, requests: Mapping[str, m.Spawn]
    ) -> tuple[dict[str, m.TaskStatus], list[PbonetError]]:
        """Have tasks created; of one that an interrupt leaves behind nothing stays.

        Returns:
            The status of each that was created, by RTPU, and the errors of the others.
        """
        ask = partial(
            self.clients.each,
            requests.__getitem__,
            m.TaskStatus,
            rtpus=requests,
            timeout=_LONGEST_SPAWN,
        )
        if self._virtual:
            return ask()
        under_way = InThread(ask)  # so that Ctrl-C ends the wait, not the requests
        try:
            under_way.begin()
            return under_way.result()
        except BaseException as error:
            if not isinstance(error, Exception):
                self._end_begun(requests, under_way)
            raise

    def _end_begun(
        self, requests: Mapping[str, m.Spawn], under_way: InThread[Any]
    ) -> None:
        """Kill tasks that are being created, until no request is under way."""
        over = False
        while not over:
            over = under_way.done(KILL_AGAIN_TIME)  # what comes after it is in vain
            kills = {
                rtpu: m.Control(task=one.task, signal="kill", timeout=CONTROL_TIME)
                for rtpu, one in requests.items()
            }
            self.clients.each(
                kills.__getitem__, m.TaskStatus, rtpus=kills, timeout=CONTROL_TIME
            )

    def _record_first(self) -> None:
        """Have the run recorded before its first task is created."""
        if not len(self.model):
            self.recordings.begin(self.clients, self.files, self.warned)

    def _created(self, member: Member, status: m.TaskStatus) -> None:
        """Enter a task that was created into the task model."""
        self.model.spawned(member)
        self._modules.pop(member.name, None)
        self.note(status)

    def interrupts(self, what: str, *, first: bool = True) -> InterruptsInTurn:
        """Return a context in which no interrupt ends what is undone, or ended.

        In virtual time each does, as modules that may hang run in this process.

        Args:
            what: What is undone, or ended, for messages.
            first: Whether an interrupt ends the block; otherwise none does.
        """
        from .interrupt_signals import InterruptsInTurn

        return InterruptsInTurn(
            what,
            f"'pbonet stop {self.clients.sbs.subsystem}' turns off what is left then",
            self.clients.awaited,
            first=first,
            idle=self._virtual,
        )

    def order_lost(self, items: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
        """Give tasks that cannot be reached the order to go off when they can be.

        Every RTPU in reach repeats it to theirs when that is seen again, before
        anything that it writes is used.

        Args:
            items: Pairs of task and signal.

        Returns:
            The items for the RTPUs that answer.

        Raises:
            PbonetError: No RTPU has taken the order.
        """
        lost: dict[str, list[str]] = {}
        for task, signal in items:
            rtpu = self.model.find(task).rtpu
            if signal == "off" and rtpu in self._missing:
                lost.setdefault(rtpu, []).append(task)
        if not lost:
            return list(items)
        gone = {task for tasks in lost.values() for task in tasks}
        self.standbys.inform([(task, "off") for task in gone], ready=False)
        stop_id = os.urandom(8).hex()
        taken, errors = self.clients.each(
            lambda _: m.Replaced(stop_id=stop_id, tasks=lost, timeout=STOP_TIME),
            m.Stopped,
            rtpus=[name for name in self.clients.names if name not in self._missing],
            timeout=STOP_TIME + rpc.ANSWER_TIME,
        )
        if not taken:
            rpc.raise_all("no RTPU takes the order to turn a lost task off", errors)
        self.warn(map(str, errors))
        self.warn(
            f"{' '.join(tasks)} may still be ON on {rtpu}, and will be turned off when "
            "that is in reach again"
            for rtpu, tasks in lost.items()
        )
        return [item for item in items if item[0] not in gone]

    def control(
        self, task: str, signal: str, arg: str, replaces: Sequence[str] = ()
    ) -> m.TaskStatus:
        """Send one signal.

        Args:
            task: The receiving task.
            signal: Which.
            arg: Text for the module.
            replaces: For ``reinit``: tasks that leave, whose constants it takes over.

        Raises:
            PbonetError: It was refused, or a method of the module failed.
        """
        rtpu = self.home(task, signal)
        request = m.Control(task=task, signal=signal, arg=arg, timeout=CONTROL_TIME)
        request.replaces = list(replaces)
        self.standbys.inform([(task, signal)], ready=False)
        limit = (1.0 + m.MOST_EXTRA) * CONTROL_TIME
        status = self.clients.call(rtpu, request, m.TaskStatus, timeout=limit)
        self.model.ordered(task, signal)
        self.standbys.inform([(task, signal)], ready=True)
        self.note(status)
        if signal == "kill":
            self._inbox.bury([task])
        return status

    def home(self, task: str, signal: str) -> str:
        """Return the RTPU of a task to send a signal to; the dead may be killed.

        Raises:
            UnknownTaskError: There is no such task.
        """
        died = "" if task in self.model else self._inbox.dead().get(task, "")
        return died if died and signal == "kill" else self.model.find(task).rtpu

    def send(
        self, items: Sequence[tuple[str, str]], before: Sequence[tuple[str, str]] = ()
    ) -> dict[str, str]:
        """Send signals in order, in as few messages as the order allows.

        Args:
            items: Pairs of task and signal.
            before: What of the same list was carried out already, for errors.

        Returns:
            The states of the tasks concerned.

        Raises:
            ReconfigError: An item failed; the rest was not sent.
        """
        self.standbys.inform(items, ready=False)
        states = send_signal_list.send(
            self.model, self.clients, items, CONTROL_TIME, before=before
        )
        self.standbys.inform(items, ready=True)
        self._inbox.bury(task for task, signal in items if signal == "kill")
        return states

    def settle(self) -> None:
        """After a change: send priorities, raise or clear the flag of equation 2.

        Inputs that have no writer any more are reported. What goes wrong here is a
        warning
        too: the change has its own outcome.
        """
        try:
            problems = self._problems()
            if self._whole:  # else the flag stays as it is
                self._unwritten.settle(warning_dedup.unwritten(problems))
            self._standing.keep(problems)
            self.rank()
        except PbonetError as error:
            self.warned(f"after the change: {error}")

    def keep(self) -> None:
        """After a change of times alone: forget warnings that do not hold any more."""
        self._standing.keep(self._problems())

    @staticmethod
    def priorities(members: Iterable[Member]) -> dict[str, int]:
        """Return the user priorities that follow from the data flow (6.2.4)."""
        return legality.user_priorities([member.task for member in members])

    def rank(self) -> None:
        """Tell the RTPUs the user priorities that they do not have.

        Criticalities are their own rule's.
        """
        priorities = self.priorities(self.reached)
        ranks: dict[str, dict[str, tuple[int | None, int]]] = {}
        for member in self.reached:
            priority = priorities[member.name]
            if self._priorities.get(member.name) != priority:
                rank = (member.rmod.crit, priority)
                ranks.setdefault(member.rtpu, {})[member.name] = rank
        ranked, errors = self.clients.each(
            lambda rtpu: m.Rank(tasks=ranks[rtpu]), NoneType, rtpus=ranks
        )
        for rtpu in ranked:
            self._priorities |= {task: rank[1] for task, rank in ranks[rtpu].items()}
        self.warn(map(str, errors))

    # -- ending -----------------------------------------------------------------------

    def leave(self) -> list[PbonetError]:
        """Close the table, its keeper last, and give the RTPUs back."""
        errors: list[PbonetError] = []
        for rtpu in reversed(self.clients.keeper_first):
            try:
                self.clients.call(rtpu, m.CloseTable(), NoneType)
            except PbonetError as error:
                errors.append(error)
        return errors or self.clients.release()

    def order_of_off(self) -> list[str]:
        """Return the order in which the tasks are turned off."""
        stated = self.files.job.off_order if self.files.job else ()
        return legality.off_order([member.task for member in self.model], stated)

    def off(self) -> list[tuple[Member, PbonetError]]:
        """Turn OFF task by task in order; return those that did not, with why."""
        failed: list[tuple[Member, PbonetError]] = []
        for name in self.order_of_off():
            member = self.model.get(name)
            if member is None or not member.is_on:
                continue
            try:
                self.send([(name, "off")])
            except PbonetError as error:
                failed.append((member, error))
        return failed

    def stop(self) -> tuple[m.Stopped, list[PbonetError], dict[str, list[str]]]:
        """Stop every RTPU at once.

        Returns:
            The results, the errors, and the tasks that may still be ON, by RTPU.
        """
        request = m.Stop(
            timeout=STOP_TIME, order=self.order_of_off(), stop_id=os.urandom(8).hex()
        )
        results, errors = self.clients.each(
            lambda _: request, m.Stopped, timeout=STOP_TIME + rpc.ANSWER_TIME
        )
        self.clients.pass_to_gateways(request)
        self.recordings.end()
        stopped = configuration.all_stopped(results.values())
        unsure: dict[str, list[str]] = {}
        for member in list(self.model):
            if member.rtpu in results:
                self.model.remove(member.name)
            elif member.is_on:
                unsure.setdefault(member.rtpu, []).append(member.name)
        return stopped, errors, unsure


def _place(rmod: Rmod) -> str:
    """Return the path of an RMOD, or its name if it has no file of its own."""
    path = Path(rmod.file)
    own = path.suffix == ".rmod" and path.is_file()
    return str(path.absolute()) if own else f"{rmod.name}.rmod"
