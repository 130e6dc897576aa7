"""The process of one task: the module in the main thread, and no other thread.

The fork server creates it with everything imported. Commands arrive as packets on its
socket; while the task cycles, the RTPU process also sets a request in the task's slot,
which makes the native loop return between two cycles. When the RTPU process or the fork
server ends, so does the task: it runs `off` and `kill` within a second.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import math
import os
import select
import signal
import socket
from typing import TYPE_CHECKING, Final

import msgspec

from pbonet.config import Library, TaskType, forget_common, load_common, parse_rmod
from pbonet.errors import MethodError, PbonetError, RealTimeError, Severity
from pbonet.log import Did, code_of
from pbonet.node import rt
from pbonet.node.ring import Ring
from pbonet.node.wire import lifecycle, process_setup, rtpu_messages
from pbonet.outside import ModuleAnswers, Tape, use
from pbonet.pbo import State, bind, decode_params, text_of
from pbonet.svar import Action, Table, var_bytes
from pbonet.xm import live_on
from pbonet.xm.net import event_codes

from . import journal, task_channel
from .code_pages import code_pages
from .deliver_timing_failure import TimingFailureDelivery
from .executor import Executor
from .parameters_in_task import get_params, set_param
from .slot_timing import SlotWatch
from .step_failures import ALL_REFUSED, RAISED, Raised, contained, refused, too_old
from .successor_calls import Found, Successors
from .task_channel import Context, RtpuChannel, SlotTime
from .task_flag_causes import TaskFlagCauses
from .task_ports import (
    by_attribute,
    check_ports,
    keep_fresh,
    keep_safe,
    local_table,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.config import Rmod
    from pbonet.log import TaskAbout

_SEED_BYTES: Final = 6
"""Of a seed, which any program that reads JSON keeps exactly."""
_LEAST_RING: Final = 1 << 20
"""Bytes of a ring for records; the smallest."""
_MOST_RING: Final = 1 << 25
"""Bytes of a ring for large records; all of them are memory that the task holds."""
_RECORDS: Final = 16
"""Records for which a ring has room, up to that: some passes of the recorder."""
_REST: Final = 1 << 14
"""Bytes of a record for its head, and for what a cycle hears from outside."""


class Prepared:
    """Work that the fork server does once for all tasks; no code of a module runs."""

    def __init__(self) -> None:
        self._read: dict[Path, int] = {}
        with contextlib.suppress(Exception):  # tasks whose module needs it report it
            self._read = load_common()
            code_of(self._read)

    def check(self) -> None:
        """Before a fork: forget what was changed on disk, which tasks read again."""
        if forget_common(self._read):
            self._read = {}


def run(sock_fd: int, spec_fd: int, crash_fd: int, server: int) -> int:
    """Run the task that the specification describes; return the exit code."""
    orphan_fd = rt.orphan_guard(task_channel.ORPHAN_SIGNAL, server)
    # Only its own stack: reading the stacks of running threads can end the process.
    faulthandler.register(rtpu_messages.DUMP_SIGNAL, crash_fd, all_threads=False)
    sock = socket.socket(fileno=sock_fd)
    ours = os.getpid()
    os.register_at_fork(after_in_child=lambda: cut_off(sock_fd, crash_fd))
    data = os.pread(spec_fd, os.fstat(spec_fd).st_size, 0)
    os.close(spec_fd)
    spec = msgspec.msgpack.decode(data, type=rtpu_messages.TaskSpec)
    to_rtpu = RtpuChannel(sock)
    try:
        core = rt.CoreTable(spec.core, member=False)
        host = Host(spec, to_rtpu, core, orphan_fd)
        host.take_signals()
        host.create()
        if os.getpid() != ours:  # the module forked, and this is the copy
            os._exit(0)
        host.slot.vow()
    except PbonetError as error:
        to_rtpu.say(
            rtpu_messages.Done(n=0, state=State.NOT_CREATED, error=error.to_wire())
        )
        return 0
    host.settle()
    host.live()
    return 0


def record_bytes(told: TaskAbout) -> int:
    """Return how large a record of the task may be, with all its variables."""
    variables = [*told.invar, *told.outvar, *told.inconst, *told.outconst]
    return _REST + sum(16 + var_bytes(one) for one in variables)


def ring_bytes(told: TaskAbout) -> int:
    """Return how large a ring the task gets for its records.

    A record that is larger than the largest ring is counted as lost.
    """
    return max(_LEAST_RING, min(_RECORDS * record_bytes(told), _MOST_RING))


def cut_off(*fds: int) -> None:
    """Take a process that the module has forked off the task's own channels."""
    null = os.open(os.devnull, os.O_RDWR)
    for fd in fds:
        os.dup2(null, fd)
    os.close(null)


class Host:
    """A task's process: makes the instance, handles messages, cycles.

    Args:
        spec: The task's specification.
        voice: The socket to the RTPU process.
        core: The table of its core.
        orphan_fd: Readable when the parent has ended.
    """

    def __init__(
        self,
        spec: rtpu_messages.TaskSpec,
        to_rtpu: RtpuChannel,
        core: rt.CoreTable,
        orphan_fd: int = -1,
    ) -> None:
        self.spec = spec
        self.to_rtpu = to_rtpu
        self._orphan_fd = orphan_fd
        self._over = False
        self._asked_to_end = ""
        self._waiting_outside = False
        self._old = ""
        """The last report of an input that was too old."""
        self.predecessors: list[str] = []
        """The tasks whose out-vars it takes over while it is a standby."""
        self._engaged = b""
        """Its message after `on`, encoded in advance because its first cycle waits."""
        self._wake_read = -1
        self.core = core
        self.slot = rt.Slot(core, spec.slot)
        self.successors = Successors(core, self.open_core)
        self.watch = SlotWatch(self.slot.failures)
        self.decoder: msgspec.msgpack.Decoder[rtpu_messages.ToTask] = (
            msgspec.msgpack.Decoder(rtpu_messages.ToTask)
        )

    # -- birth -------------------------------------------------------------------------

    def take_signals(self) -> None:
        """Let SIGTERM and SIGINT end the task."""
        self._wake_read, wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(wake_write, warn_on_full_buffer=False)
        for which in (signal.SIGTERM, signal.SIGINT):
            signal.signal(which, self._on_signal)
            rt.see_interrupt(which)

    def open_core(self, number: int) -> rt.CoreTable:
        """Return the table of a core.

        Raises:
            PbonetError: The table cannot be opened.
        """
        return rt.CoreTable(number, member=False)

    def library(self) -> Library:
        """Return the library of the module."""
        return Library(self.spec.libraries)

    def attach(self) -> Table:
        """Return the subsystem's table.

        Raises:
            SvarError: The table cannot be opened.
        """
        return Table.attach(self.spec.table, layout=self.spec.layout)

    def live_in_process(self) -> None:
        """Set the RTPU, domain and devices that the module sees as its own."""
        spec = self.spec
        live_on(
            spec.rtpu,
            domain=spec.domain,
            priority=self.watch.ranked,
            subsystem=spec.subsystem,
        )
        if spec.devices:
            from pbonet.io.drivers import database

            database.use(spec.devices, f"{spec.rtpu}/{spec.task}")
        needs = {one.needs for one in (self.rmod, *self.rmod.parts) if one.needs}
        if spec.spps or needs:
            from pbonet.io.spp import processors, require

            processors.use(spec.spps, f"{spec.rtpu}/{spec.task}")
            require(needs)

    def create(self) -> None:
        """Load the module, bind it to the table, and run its `init`.

        Raises:
            PbonetError: The RMOD, the module, the table or `init` is at fault.
        """
        spec = self.spec
        self.rmod: Rmod = parse_rmod(spec.rmod, spec.rmod_name)
        library = self.library()
        loaded = library.load_rmod(self.rmod)
        self.info = loaded.info
        check_ports(self.rmod, loaded.info)
        params = decode_params(loaded.cls, self.rmod.settings, where=self.rmod.file)
        self.table = self.attach()
        self.local = local_table(self.table, spec.task, self.rmod)
        self.reacts = keep_fresh(self.local, self.table, self.rmod, self.info)
        told = journal.about(
            spec, self.rmod, self.info, library, self.table, seed=self.seed()
        )
        self.safe = b""
        if self.rmod.safe_at:
            self.safe = keep_safe(self.local, self.rmod, self.info)
        self.ring = self.record(told)
        self.tape = self.slot.tape = Tape()
        use(self.tape)
        told_of = ModuleAnswers()
        self.time = SlotTime(self.slot, told_of)
        self.journal = journal.Journal(
            self.local, self.ring, told, self.time, self.tape
        )
        self.context = Context(
            spec.task,
            rmod=self.rmod.name,
            freq=spec.freq,
            source=self.time,
            outbox=self.to_rtpu,
            handler=self.rmod.handler,
            watch=self.watch,
            seed=told.seed,
        )
        self.context.slot = self.slot
        self.context.safe_at = self.rmod.safe_at
        self.context.libraries = tuple(map(str, library.folders))
        self.context.told = self.watch.told = told_of
        self.to_rtpu.own = {one.name: one.bit for one in self.info.signals}
        self.watch.task = self.context
        self.context.on_off = lambda: self.core.request(spec.slot)
        arrays = {
            port.attr: self.local.array(self.rmod.svar_name(port.name))
            for port in self.info.ports
        }
        self.live_in_process()
        instance = bind(loaded.cls, params, arrays, self.context)
        stale = by_attribute(self.rmod, self.info, self.local.stale)
        age = by_attribute(self.rmod, self.info, self.local.age)
        self.context.is_stale = lambda port: told_of.ask(
            lambda: stale(port), default=False
        )
        stamp = by_attribute(self.rmod, self.info, self.local.stamp_of)
        self.context.stamp_of = lambda port: stamp(port) or self.context.now
        self.context.age_of = lambda port: told_of.ask(
            lambda: age(port), default=math.inf
        )
        illegal = (lambda: self.local.illegal) if self.rmod.critical else None
        self.executor = Executor(instance, self.journal, illegal=illegal)
        self.executor.cycling = self._method
        ours = {Host._cycle.__code__, Host._sync.__code__}
        self.telling = TimingFailureDelivery(self.executor, told_of, self.time, ours)
        self.flag_causes = TaskFlagCauses(
            self.table, f"{spec.rtpu}/{spec.task}", self.context
        )
        with self.journal.doing(Did("spawn")), self.local.replacing(spec.replaces):
            self.executor.spawn()

    def seed(self) -> int:
        """Return a new seed for the task's random numbers."""
        return int.from_bytes(os.urandom(_SEED_BYTES))

    def record(self, told: TaskAbout) -> Ring:
        """Return the ring for the task's records."""
        room, about = ring_bytes(told), msgspec.json.encode(told)
        return Ring.create(self.spec.ring, room, about)

    def settle(self) -> None:
        """Prepare the process for real time, then report that the task is OFF."""
        notes: list[str] = []
        try:
            rt.lock_memory()
            rt.populate_pages(code_pages())
        except RealTimeError as error:
            notes.append(f"memory is not locked: {error}")
        rt.prefault_stack()
        rt.set_timer_slack()
        rt.pin(self.spec.core)
        process_setup.settle_memory()
        self.slot.command_level()
        self.slot.meet_dispatcher()
        try:
            rt.drop_rights()
        except RealTimeError as error:
            notes.append(str(error))
        if self.outside:
            task_channel.interrupt_waits(self.to_rtpu.sock, self._on_message)
        self.ready(notes)

    def ready(self, notes: list[str]) -> None:
        """Report that the task is OFF, with its description."""
        ready = rtpu_messages.TaskReady(
            module=self.info.name,
            version=self.info.version,
            critical_ok=self.info.critical_ok,
            tells="timing_failure" in self.info.methods,
            safe=self.safe,
            notes=notes,
            signals=self.to_rtpu.own,
            info=msgspec.to_builtins(self.info),
        )
        self._answer(0, ready)

    # -- life --------------------------------------------------------------------------

    @property
    def outside(self) -> bool:
        """Whether the module's `sync` decides when a cycle is due."""
        return self.rmod.tasktype is not TaskType.PERIODIC

    def live(self) -> None:
        """Handle messages and cycle until the task is killed or orphaned."""
        while not self._over:
            if self._asked_to_end or rt.orphaned():
                self.end(self._asked_to_end or "its parent process is gone")
            elif self.executor.state is State.ON:
                self._cycle()
            elif self.predecessors:
                self._stand_by()
            else:
                self._wait()
        self._close()

    def _wait(self) -> None:
        sock = self.to_rtpu.sock
        files = [sock.fileno(), self._orphan_fd, self._wake_read]
        ready, _, _ = select.select(files, self.to_rtpu.owing, [])
        self.to_rtpu.pay()
        if self._wake_read in ready:
            os.read(self._wake_read, 512)
        if sock.fileno() in ready:
            self._take()

    def _stand_by(self) -> None:
        """Wait while OFF until the dispatcher engages the task or a message arrives."""
        if self.slot.stand_by() == rt.ENGAGED:
            self._engage()
        self._take()

    def _engage(self) -> None:
        """Turn ON because predecessors have ended, without a signal from a master."""
        failed: PbonetError | None = None
        self.predecessors = []
        kind = self.slot.after or -1  # 0: withdrawn before it could run
        self.local.given_up = lambda: self.slot.after != kind
        self.time.turned_on()
        try:
            self.local.have_ended()
            with self.journal.doing(Did("on", handover=True)):
                self.executor.signal("on", handover=True)
        except PbonetError as error:
            failed = error
        finally:
            self.local.take_over_from([])
        if self.executor.state is State.ON:
            self.slot.arm()
            self.to_rtpu.send(self._engaged)
            return
        self._after_signal()
        self.to_rtpu.notice(
            Severity.ERROR if failed else Severity.INFO,
            "ENGAGED",
            str(failed or self.executor.state),
            state=self.executor.state,
            error=failed,
        )

    def _cycle(self) -> int:
        """Cycle until a message waits or something fails; return the reason."""
        instance = self.executor.instance
        reason = 0
        if not self.to_rtpu.pay():
            self.core.request(self.spec.slot)  # return after a cycle, to send reports
        self.time.cycling = True
        try:
            reason = self.slot.run(
                instance.cycle,
                self.local,
                stable=instance.stable,
                safe=self.executor.write_safe,
                critical=self.executor.critical,
                sync=self._sync if self.outside else None,
                ring=self.ring,
                leave=ALL_REFUSED,
                failing=self.telling,
                aged=self._aged if self.reacts else None,
            )
            if reason == rt.FLAGS:
                self.time.cycling = False
                old = self.slot.action == Action.ERROR
                blamed = self.local.blamed
                self._fault(
                    too_old(blamed) if old else refused(self.slot.flags, blamed)
                )
            elif reason == rt.ABORTED:
                self.time.cycling = False
                self._begin_anew()
        except task_channel.Interrupted:
            self._waiting_outside = False
            self.journal.broken_off()
        except RAISED as error:
            self.time.cycling = False
            self._fault(contained(error))
        self.time.cycling = False
        if self.context.off_requested and self.executor.state is State.ON:
            self._obey("off")
        self._take()
        return reason

    def _aged(self, stale: bool) -> None:  # noqa: FBT001 - called by the native loop
        """Report that inputs became stale, or have been fresh for long enough.

        A CRITICAL task raises the flag meanwhile; another one acts alone.
        """
        if stale:
            name = self.local.blamed.variable
            self._old = f"the input {name} of {self.spec.task} is stale"
        if self.rmod.critical:
            self.flag_causes.aged(self._old * stale)
        elif stale:
            does = Action(self.local.action).name.lower()
            self.to_rtpu.notice(Severity.WARNING, "STALE", f"{self._old}: {does}")
        else:
            text = f"the inputs of {self.spec.task} are fresh again"
            self.to_rtpu.notice(Severity.INFO, "FRESH", text)

    def _sync(self) -> None:
        """Wait as the module's `sync` does; a message that arrives ends the wait."""
        self._waiting_outside = True
        if self.to_rtpu.waits() or self._asked_to_end:
            raise task_channel.Interrupted  # it came before the wait began
        self.executor.instance.sync()
        self._waiting_outside = False

    def _method(self) -> str:
        """Return the current or last method of the native loop."""
        if self.slot.failures.error is not None:
            return "timing_failure"
        if self._waiting_outside:
            return "sync"
        return "stable" if self.slot.stable else "cycle"

    def _on_message(self) -> None:
        if self._waiting_outside:
            raise task_channel.Interrupted

    def _begin_anew(self) -> None:
        """Restart after a cycle that the module's handler or its safe values ended."""
        did = Did("abort", calls=self.tape.calls(), name="safe" * self.slot.safe)
        try:
            with self.journal.doing(did):
                self.executor.made_safe = self.slot.safe
                self.executor.abort()
        except PbonetError as error:
            self.to_rtpu.report(error, self.executor, self.time.cyclecount)
        if self.executor.state is not State.ON:
            self._disarm()
            self.to_rtpu.notice(
                Severity.WARNING,
                "STATE",
                f"after a timing failure it is {self.executor.state}",
                cycle=self.time.cyclecount,
                state=self.executor.state,
            )

    def _fault(self, error: Raised) -> None:
        """Let the executor handle an exception of a cycle, and report it."""
        method = self._method()
        self._waiting_outside = False
        settled = False
        try:
            with self.journal.doing(Did("fault", name=method, arg=text_of(error))):
                self.executor.made_safe = self.slot.safe
                self.executor.fault(error, method)
            settled = self.executor.failure is None
        except PbonetError as second:
            error = second
        if self.executor.state is not State.ON:
            self._disarm()
        if not settled:  # else the handler's own event reports it
            self.to_rtpu.report(error, self.executor, self.time.cyclecount)

    def _obey(self, signal: str) -> None:
        """Carry out a signal that no request waits for; report the result."""
        failed: PbonetError | None = None
        try:
            with self.journal.doing(Did(signal)):
                self.executor.signal(signal)
        except PbonetError as error:
            failed = error
        self._after_signal()
        self.to_rtpu.notice(
            Severity.ERROR if failed else Severity.INFO,
            "METHOD" if failed else "STATE",
            str(failed or event_codes.signal_text(signal, self.executor.state)),
            cycle=self.time.cyclecount,
            state=self.executor.state,
            error=failed,
        )

    def _take(self) -> None:
        """Handle all waiting messages."""
        while not self._over:
            data = self.to_rtpu.receive()
            if data is None:
                return
            if not data:
                self.end("the RTPU process is gone")
                return
            message = self.decoder.decode(data)
            try:
                result = self._do(message)
            except PbonetError as error:
                self._after_signal()
                self._answer(message.n, None, error)
            else:
                self._answer(message.n, result)

    def _do(self, message: rtpu_messages.ToTask) -> object:
        match message:
            case rtpu_messages.Signal():
                return self._signal(message)
            case rtpu_messages.Prepare():
                self._prepare(message)
            case rtpu_messages.Calls():
                self.successors.find(message.calls)
            case rtpu_messages.Disown():
                self.local.release()
            case rtpu_messages.SetParam():
                did = Did("set", name=message.name, arg=message.value)
                with self.journal.doing(did):
                    return set_param(
                        self.executor, self.info, message.name, message.value
                    )
            case rtpu_messages.GetParam():
                return get_params(self.executor, self.info, message.name)
            case rtpu_messages.SetFreq():
                with self.journal.doing(Did("freq", hz=message.hz)):
                    self.context.freq = message.hz
        return None

    def _signal(self, message: rtpu_messages.Signal) -> tuple[list[str], bool]:
        """Carry out a signal.

        Returns:
            Called successors that have died, and whether the task is a standby.
        """
        which = message.signal
        calls = self.successors.find(message.calls)
        if which == "on":
            self.time.turned_on()
        did = Did(which, arg=message.arg, handover=message.handover, cede=message.cede)
        with self.journal.doing(did), self.local.replacing(message.replaces):
            self.executor.signal(
                which, message.arg, handover=message.handover, cede=message.cede
            )
        heard = self._after_signal(calls)
        called = zip(message.calls, heard, strict=False)
        gone = [call.successor for call, there in called if not there]
        if message.then is not None and self.executor.state is State.OFF:
            with contextlib.suppress(PbonetError):
                self._prepare(message.then)
        return gone, bool(self.predecessors)

    def _prepare(self, wanted: rtpu_messages.Prepare) -> None:
        """Become a standby for other tasks; refused in the same cases as `on`."""
        self.predecessors, after = [], wanted.after
        self.local.take_over_from([])
        if not after:
            return
        lifecycle.rule(self.executor.state, lifecycle.Event.ON, where=self.spec.task)
        self.local.take_over_from([*after, *wanted.owners])
        try:
            self.local.check_claim()
        except PbonetError:
            self.local.take_over_from([])
            raise
        if wanted.far:
            self.local.take_over_from([one for one in after if one not in wanted.far])
        self.predecessors = after
        self._engaged = rtpu_messages.encode(
            rtpu_messages.Notice(
                severity=int(Severity.INFO),
                code="ENGAGED",
                text=f"in place of {' and '.join(after)}",
                state=State.ON,
            )
        )

    def _after_signal(self, calls: Sequence[Found] = ()) -> list[bool]:
        """Adjust the slot to the state; see `_disarm`."""
        state = self.executor.state
        heard: list[bool] = []
        if state is not State.ON:
            heard = self._disarm(calls)
            self._tidy()
        if state is State.NOT_CREATED:
            self._over = True
        return heard

    def _tidy(self) -> None:
        """Leave no garbage for the collector in the next cycles."""
        gc.collect()
        gc.freeze()

    def _disarm(self, calls: Sequence[Found] = ()) -> list[bool]:
        """Stop releases; engage the successors, or in ERROR the fallback.

        Returns:
            For each called successor whether it is alive.
        """
        heard: list[bool] = []
        if self.executor.state is State.ERROR:
            self.slot.fall()
        else:
            heard = self.slot.disarm(calls)
        self.successors.close()
        self.flag_causes.end()
        return heard

    def _answer(self, n: int, result: object, error: PbonetError | None = None) -> None:
        wired = PbonetError.to_wire(error) if error else None  # includes its line
        state = self.executor.state.value
        done = rtpu_messages.Done(n=n, state=state, result=result, error=wired)
        if isinstance(error, MethodError):
            done.errnum, done.place = error.number, error.place
        self.to_rtpu.say(done)

    # -- death -------------------------------------------------------------------------

    def end(self, reason: str) -> None:
        """Run `off` and `kill` when the task ends without having received them."""
        self.to_rtpu.notice(
            Severity.WARNING,
            "ENDING",
            f"the task ends: {reason}",
            cycle=self.time.cyclecount,
        )
        if self.executor.state is not State.NOT_CREATED:
            self._obey("kill")
        self._over = True

    def _close(self) -> None:
        self.slot.disarm()
        with contextlib.suppress(PbonetError, OSError):
            self.local.close()
        if rt.orphaned():
            with contextlib.suppress(PbonetError, OSError):
                self.ring.destroy()

    def _on_signal(self, number: int, _frame: object) -> None:
        self._asked_to_end = signal.Signals(number).name
        self.core.request(self.spec.slot)
        self._on_message()
