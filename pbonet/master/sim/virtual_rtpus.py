"""RTPUs in virtual time: a subsystem's agents without processes, network or devices.

`VirtualRtpus` answers the requests that agents answer (`messages`), out of
the simulation that `pbonet run --sim` uses. So a program that steers a `Subsystem` runs
unchanged in virtual time, with every command and every refusal, and comes to the same
result each time. What only time itself can do to tasks is not there: nothing is late,
nothing hangs, no execution time is measured.
"""

from __future__ import annotations

import os
import platform
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.config import parse_rmod
from pbonet.errors import PbonetError, StateError, SvarOwnerError
from pbonet.io import no_devices
from pbonet.master.configuration import Member, RmodSource
from pbonet.node.task import get_params, inspect, set_param
from pbonet.node.wire import by_task
from pbonet.pbo import PREDEFINED, Notice, State, signal_names
from pbonet.svar import guards
from pbonet.xm.net import machine, messages as m, rpc

from .sim_task import must_be_simulated, status_of
from .simulation import REASON, Simulation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from threading import Event

    from pbonet.config import Library
    from pbonet.master.configuration import Files

    from .sim_task import SimTask

HOST = "virtual"
"""The name of the machine that is none."""


class VirtualRtpus(Simulation):
    """The RTPUs of a subsystem, answering as their agents would.

    Args:
        files: The subsystem's files.
    """

    def __init__(self, files: Files) -> None:
        self._begin(files, {"subsystem": files.sbs.subsystem})
        self.told: list[Callable[[], None]] = []
        """Called whenever something happens."""
        self._lock = threading.RLock()
        self._logs = self.happened.logs
        for log in self._logs.values():
            log.publish = self._published
        self._signals: dict[str, dict[str, int]] = {}
        self._writers: dict[str, str] = {}
        self._masks: dict[str, list[str]] = {}
        self._raised: dict[str, list[str]] = {}
        """Causes under which the master has the flag up."""
        self._steady = True
        self._job: m.Standing | None = None
        self._epochs = self._spawns = 0
        self._do: dict[type[m.Request], Callable[[str, Any], object]] = {
            m.Hello: self._hello,
            m.Claim: self._claim,
            m.Spawn: self._spawned,
            m.Control: self._control,
            m.Reconfig: self._reconfig,
            m.Standby: self._stand_by,
            m.Freq: self._freq,
            m.Get: self._get,
            m.Set: self._set,
            m.Rank: self._ranked,
            m.Status: self._status_of,
            m.Display: self._display,
            m.Write: self._write,
            m.Modules: self._modules,
            m.Stop: self._stop,
            m.Flag: self._flag,
            m.Sigmask: self._sigmask,
            m.Job: self._stand,
            m.Events: lambda rtpu, request: self._logs[rtpu].since(request.since),
            m.Profile: self._profile,
            m.OpenTable: self._open_table,
            m.CloseTable: self._nothing,
            m.Release: self._nothing,
        }

    @property
    def library(self) -> Library:
        """Where the modules come from."""
        return self._library

    def answer(self, rtpu: str, request: m.Request) -> m.Answer:
        """Carry out a request, at this instant."""
        with self._lock, no_devices(REASON):
            try:
                result = self._do[type(request)](rtpu, request)
            except PbonetError as error:
                return m.Answer(id=request.id, ok=False, error=error.to_wire())
        plain = msgspec.to_builtins(result, builtin_types=(bytes,))
        return m.Answer(id=request.id, ok=True, result=plain)

    def pass_time(self, seconds: float, until: Event) -> bool:
        """Let virtual time pass, or an event be set; tell whether it is."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while not until.is_set():
            with self._lock:
                if not self.step(end_ns):
                    break
        return until.is_set()

    # -- what tasks tell --------------------------------------------------------------

    def _after(self, task: SimTask, notices: Sequence[Notice]) -> None:
        """Count signals and who writes what, beside what a simulation does."""
        super()._after(task, notices)
        for notice in notices:
            self._count(task, notice.bits)
        on = task.executor.state is State.ON
        for name in task.member.task.outputs if on else ():
            self._writers[name] = task.name

    def _look_for_causes(self) -> None:
        """Take what raises the flag as on real RTPUs: the master, and tasks in ERROR.

        Of both only such whose variables nobody writes by now.
        """
        tasks = [*self._tasks.values()]
        states = {task.name: task.executor.state for task in tasks}
        written = {
            name
            for task in tasks
            if states[task.name] is State.ON
            for name in task.member.task.outputs
        }
        for cause, unfed in list(self._raised.items()):
            if unfed and written.issuperset(unfed):
                del self._raised[cause]
        self.table.causes = {f"{cause} (master)" for cause in self._raised} | {
            f"{task.name} is in ERROR ({task.member.rtpu}/{task.name})"
            for task in tasks
            if states[task.name] is State.ERROR
            and not written.issuperset(self._standbys.missed(task))
        }

    def _look_at_flag(self) -> None:
        self._look_for_causes()
        self.happened.flagged(self.table.illegal, told=True)

    def _published(self, _: m.Event) -> None:
        for told in self.told:
            told()

    def _count(self, task: SimTask, bits: int) -> None:
        counts = self._signals[task.name]
        masked = self._masks.get(task.name, self._masks.get("", []))
        for name in signal_names(bits, _own(task)):
            if name not in masked:
                counts[name] = counts.get(name, 0) + 1

    # -- requests ---------------------------------------------------------------------

    def _hello(self, rtpu: str, _: m.Hello) -> m.AgentInfo:
        return m.AgentInfo(
            name=rtpu,
            domain=HOST,
            host=HOST,
            machine=machine(),
            core=0,
            cores=1,
            pid=os.getpid(),
            rtpu_pid=0,
            backend="inline",
            version="",
            python=platform.python_version(),
        )

    def _nothing(self, _rtpu: str, _: m.Request) -> None:
        """Do nothing: who else could have it."""

    def _flag(self, _rtpu: str, request: m.Flag) -> list[str]:
        self._raised.pop(request.cause, None)
        if request.up:
            self._raised[request.cause] = request.unfed
        self._look_at_flag()
        return sorted(self.table.illegal)

    def _claim(self, _rtpu: str, _: m.Claim) -> m.Claimed:
        self._epochs += 1
        return m.Claimed(epoch=self._epochs)

    def _open_table(self, _rtpu: str, request: m.OpenTable) -> m.TableInfo:
        return m.TableInfo(name=request.subsystem, layout="", machine=machine())

    def _spawned(self, rtpu: str, request: m.Spawn) -> m.TaskStatus:
        if request.task in self._tasks:
            raise StateError(
                f"there is a task {request.task} already",
                where=rtpu,
                remedy=f"'kill {request.task}' removes it",
            )
        record = parse_rmod(request.rmod, request.rmod_name)
        loaded = self._library.load_rmod(record)
        must_be_simulated(
            record, request.freq or record.freq, self.simulated, record.file
        )
        member = Member(
            source=RmodSource(record, request.rmod),
            rtpu=rtpu,
            freq=request.freq or record.freq or 0.0,
            info=loaded.info,
        )
        own = {one.name: one.bit for one in loaded.info.signals}
        self._signals[member.name] = dict.fromkeys([*PREDEFINED, *own], 0)
        try:
            self._spawn(member, request.replaces)
        except BaseException:
            self._tasks.pop(member.name, None)
            self.table.forget(member.name)
            raise
        self._rank()
        self._spawns += 1
        self.task(member.name).tid = self._spawns
        return self._one(self.task(member.name))

    def _control(self, _rtpu: str, request: m.Control) -> m.TaskStatus:
        return self._send(
            request.task, request.signal, request.arg, replaces=request.replaces
        )

    def _send(
        self,
        name: str,
        signal: str,
        arg: str = "",
        *,
        handover: bool = False,
        replaces: Sequence[str] = (),
    ) -> m.TaskStatus:
        task = self.task(name)
        try:
            self.signal(name, signal, arg, handover=handover, replaces=replaces)
        finally:
            if task.executor.state is State.NOT_CREATED:
                self._tasks.pop(name, None)
                self.table.forget(name)
                self._look_at_flag()
        return self._one(task)

    def _reconfig(self, _rtpu: str, request: m.Reconfig) -> m.Reconfigured:
        found = m.Reconfigured(done=0)
        for n, (name, signal) in enumerate(request.items):
            try:
                heir = signal == "off" and (
                    name in request.handover
                    or self._has_heir(name, request.items[n + 1 :])
                )
                found.states[name] = self._send(name, signal, handover=heir).state
            except PbonetError as error:
                found.error = error.to_wire()
                break
            found.done += 1
        return found

    def _stand_by(self, _rtpu: str, request: m.Standby) -> m.TaskStatus:
        original = self.task(request.original) if request.original else None
        self._standbys.pair(self.task(request.task), original)
        return self._one(self.task(request.task))

    def _freq(self, rtpu: str, request: m.Freq) -> float:
        task = self.task(request.task)
        if request.hz is not None:
            task.member.freq = task.executor.task.freq = request.hz
            self._turns[rtpu].configure(task)
        return task.member.freq

    def _get(self, _rtpu: str, request: m.Get) -> list[m.ParamValue]:
        executor = self.task(request.task).executor
        info = self._library.load_rmod(self.task(request.task).member.rmod).info
        return get_params(executor, info, request.name)

    def _set(self, _rtpu: str, request: m.Set) -> list[m.ParamValue]:
        executor = self.task(request.task).executor
        info = self._library.load_rmod(self.task(request.task).member.rmod).info
        return set_param(executor, info, request.name, request.value)

    def _ranked(self, _rtpu: str, _: m.Rank) -> None:
        self._rank()

    def _status_of(self, rtpu: str, _: m.Status) -> m.RtpuStatus:
        found = next(one for one in self.status() if one.rtpu == rtpu)
        for status in found.tasks:
            status.signals = dict(self._signals[status.task])
        found.events = by_task(self._logs[rtpu].counts(), self._files.sbs.subsystem)
        return found

    def _one(self, task: SimTask) -> m.TaskStatus:
        status = status_of(task, self.now_ns)
        status.signals = dict(self._signals[task.name])
        return status

    def _profile(self, rtpu: str, _: m.Profile) -> object:
        raise StateError(
            "a simulation measures no execution times",
            where=rtpu,
            remedy="run the tasks in real time to measure them",
        )

    def _display(self, _rtpu: str, request: m.Display) -> list[m.VarValue]:
        found = self.display(request.names or list(self.table.numbers))
        for value in found:
            value.writer = self._writers.get(value.name)
        return found

    def _write(self, _rtpu: str, request: m.Write) -> m.VarValue:
        name = request.name
        variable = self.table.variables[self.table.numbers[name]]
        for task in self._tasks.values():
            on = task.executor.state is State.ON
            if name in task.member.task.gives or (
                on and name in task.member.task.outputs
            ):
                raise SvarOwnerError(
                    f"{name} cannot be set, a task writes it",
                    where=self._files.sbs.subsystem,
                    expected="a variable that no task owns",
                    got=f"owner {task.name}",
                    remedy=f"turn {task.name} off first",
                )
        value = guards.typed(self._files.sbs.subsystem, variable, request.values)
        self.table.values[name][...] = value
        self.table.written[name] = self.now_ns
        self._writers.pop(name, None)
        return self.table.look(name, self.now_ns)

    def _modules(self, rtpu: str, request: m.Modules) -> object:
        found = inspect(self._library, request.name)
        if request.name is not None and found.errors:
            raise rpc.placed(rtpu, PbonetError.from_wire(found.errors[0]))
        return found.modules

    def _stop(self, rtpu: str, request: m.Stop) -> m.Stopped:
        here = [n for n, task in self._tasks.items() if task.member.rtpu == rtpu]
        names = [name for name in request.order if name in here]
        names += [name for name in reversed(here) if name not in names]
        self._standbys.forget(set(names))
        stopped = m.Stopped(off=[], killed=[])
        for name in names:
            if self.task(name).executor.state is State.ON:
                stopped.off.append(name)
        with self.happened.stopping():
            for name in stopped.off:
                self._last(name, "off")
            for name in names:
                self._last(name, "kill")
        self._job = None
        return stopped

    def _last(self, name: str, signal: str) -> None:
        """Send a signal to a task that is ended, if it is there yet."""
        try:
            if name in self._tasks:
                self._send(name, signal)
        except PbonetError as error:
            self.events.append(f"{self._clock()} {name}: {error}")

    def _sigmask(self, _rtpu: str, request: m.Sigmask) -> dict[str, list[str]]:
        if request.unset:
            self._masks.pop(request.task, None)
        elif request.names is not None:
            self._masks[request.task] = request.names
        return self._masks

    def _stand(self, _rtpu: str, request: m.Job) -> list[m.Standing]:
        if request.changes:
            self._job = request.told
        return [] if self._job is None else [self._job]


def _own(task: SimTask) -> dict[str, int]:
    info = task.member.info
    return {one.name: one.bit for one in info.signals} if info else {}


class _Heard:
    """A function that is called until this is undeclared."""

    def __init__(self, told: list[Callable[[], None]], one: Callable[[], None]) -> None:
        self._take_back = partial(told.remove, one)
        told.append(one)

    def undeclare(self) -> None:
        """Call it no more."""
        self._take_back()


class VirtualClient(rpc.Client):
    """Asks virtual RTPUs in place of agents.

    Args:
        rtpus: Who answers.
        domain: The domain's name, for keys that nobody sees.
        name: The master's own name.
        warned: As for `rpc.Client`.
    """

    def __init__(
        self,
        rtpus: VirtualRtpus,
        domain: str,
        name: str,
        *,
        warned: Callable[[str, str], None],
    ) -> None:
        super().__init__(None, domain, name, warned=warned)  # type: ignore[arg-type]
        self._rtpus = rtpus

    def tokens(self, key: str) -> list[str]:
        """Return nothing: there is no other master."""
        del key
        return []

    def rtpus(self) -> list[str]:
        """Return the names of the RTPUs, sorted."""
        return sorted(one.rtpu for one in self._rtpus.status())

    def announce(self, key: str) -> rpc.Declared:
        """Show nothing: nobody could see it."""
        del key
        return _Heard([], lambda: None)

    def hear(self, key: str, told: Callable[[], None]) -> rpc.Declared:
        """Have a function called whenever something happens."""
        del key
        return _Heard(self._rtpus.told, told)

    def close(self) -> None:
        """Do nothing: there is no connection."""

    def _exchange(self, rtpu: str, request: m.Request, timeout: float) -> m.Answer:
        del timeout
        return self._rtpus.answer(rtpu, request)


class VirtualClock:
    """Time that passes only where a program waits, and as fast as modules can run."""

    def __init__(self, rtpus: VirtualRtpus) -> None:
        self._rtpus = rtpus

    def now(self) -> float:
        """Return the virtual seconds."""
        return self._rtpus.now_ns * 1e-9

    def wait(self, seconds: float, until: Event) -> bool:
        """Let time pass until it is over or an event is set; tell whether it is."""
        return self._rtpus.pass_time(seconds, until)
