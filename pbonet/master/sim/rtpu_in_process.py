"""One RTPU and its tasks in virtual time, in this process.

It is the RTPU of `pbonet.node` itself: the same requests, the same state, the same
tasks. What a process of its own, shared memory and a dispatcher's thread are to that is
here a channel in memory, tables that no other can open, and turns as time passes.
"""

from __future__ import annotations

import asyncio
import zlib
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
from msgspec import structs

from pbonet.config import TaskType, parse_rmod
from pbonet.errors import NodeError, PbonetError, Severity
from pbonet.node import rt
from pbonet.node.agent import SharedMemoryStatus
from pbonet.node.ring import Ring
from pbonet.node.rtpu import (
    Child,
    Opened,
    RequestHandlers,
    Rtpu,
    Spawner,
    Tables,
    obey_neighbour,
    rtpu_snapshot,
)
from pbonet.node.task import Host, RtpuChannel, inspect, record_bytes, ring_bytes
from pbonet.node.wire import CoreWait, Neighbours, rtpu_messages
from pbonet.outside import using
from pbonet.pbo import State
from pbonet.svar import Table

from .virtual_loop import Channel, pair, running

if TYPE_CHECKING:
    import signal
    import socket
    from collections.abc import Callable, Generator

    from pbonet.analysis.schedule import CoreStatus, SlotStatus
    from pbonet.config import Library, SvarFile
    from pbonet.log import TaskAbout
    from pbonet.node.rtpu import Task
    from pbonet.node.wire import EventLog

    from .virtual_loop import VirtualLoop


class SharedState:
    """The state that the RTPUs of a simulation share.

    Args:
        loop: Their time.
        library: Where their modules come from.
        domain: A name that no other simulation of this process has.
        record: Takes the ring of each task, and whose it is.
    """

    def __init__(
        self,
        loop: VirtualLoop,
        library: Library,
        domain: str,
        record: Callable[[VirtualTask, TaskAbout], None],
    ) -> None:
        self.loop, self.library, self.domain = loop, library, domain
        self.simulated = [TaskType.PERIODIC, TaskType.SYNCHRONOUS]
        """The types of tasks that can be run."""
        self.record = record
        self.tables: dict[str, Table] = {}
        self.cores: list[VirtualCore] = []
        self.rtpus: list[VirtualRtpu] = []
        self._spawned = 0
        self._lives: Counter[str] = Counter()

    def number(self) -> int:
        """Return a number in place of a process id."""
        self._spawned += 1
        return self._spawned

    def seed(self, task: str) -> int:
        """Return the same seed for the same life of a task in every simulation."""
        self._lives[task] += 1
        return zlib.crc32(f"{task} {self._lives[task]}".encode())


class VirtualRtpu(Rtpu):
    """An RTPU whose tasks are in this process.

    Args:
        name: Its name.
        number: Stands for its core.
        world: What it has in common with the others.
        events: Where to tell what happens.
    """

    def __init__(
        self, name: str, number: int, world: SharedState, events: EventLog
    ) -> None:
        self.world = world
        self.hosts: dict[int, VirtualTask] = {}
        """By their slots."""
        config = rtpu_messages.RtpuConfig(
            domain=world.domain,
            name=name,
            core=number,
            libraries=tuple(str(one.absolute()) for one in world.library.folders),
        )
        super().__init__(config, events, None, None)  # type: ignore[arg-type]
        self.core = VirtualCore(number, virtual_ns=world.loop.now_ns)
        self.core.asked = self._asked
        world.cores.append(self.core)
        world.rtpus.append(self)
        self.operations = RequestHandlers(self)
        self.overview = VirtualOverview(self)

    def turn(self) -> None:
        """Let every task run that has a release now, the most urgent one first."""
        loop, slot = self.world.loop, -1
        while 0 < self.core.due_ns <= loop.now_ns or slot >= 0:
            slot = self.core.turn(loop.now_ns)
            loop.run()  # what the one before has said: the dispatcher comes first
            if host := self.hosts.get(slot):
                host.run()

    def now_ns(self) -> int:
        """Return the virtual time."""
        return self.world.loop.now_ns

    async def ask_neighbours(
        self, order: rtpu_messages.Order, limit: float
    ) -> Neighbours:
        """Have the RTPU that has a task carry out a signal; all are one machine."""
        del limit
        others = [one for one in self.world.rtpus if one is not self]
        names = [one.name for one in others]
        for other in others:
            answer = await obey_neighbour(other, order)
            if answer.here:
                return Neighbours(answer, names, [])
        return Neighbours(None, names, [])

    def save(self) -> None:
        """Do nothing: there is nothing to be cleaned away."""

    def watch_life(self, task: Task) -> None:
        """Do nothing: no process dies here, and no cycle fails in time."""

    def unwatch_life(self, task: Task) -> None:
        """Do nothing, likewise."""

    def _open_tables(self) -> Tables:
        return VirtualTables(self.world, changed=self.publish_claims)

    def _make_spawner(self, forks: object) -> Spawner:
        del forks
        return VirtualSpawner(self)

    def _asked(self, slot: int) -> None:
        """Have a task receive its messages."""
        if host := self.hosts.get(slot):
            self.world.loop.call_soon(host.attend)


class VirtualCore(rt.CoreTable):
    """The table of a core that is none: every task is released, and none is late."""

    asked: Callable[[int], None]

    def configure(self, i: int, **settings: Any) -> None:  # noqa: ANN401 - as they come
        """Change a slot, but for what only time itself can do to a task."""
        kept = ("pid", "period_ns", "crit", "priority")
        super().configure(i, **{k: v for k, v in settings.items() if k in kept})

    def close(self) -> None:
        """Do nothing: others of this process use it, too."""

    def end(self) -> None:
        """Release the table, which is no longer used."""
        super().close()

    def request(self, i: int, *, last: bool = False) -> None:
        """Notify a task that a message is waiting."""
        del last
        self.asked(i)

    def snapshot(self, i: int) -> SlotStatus:
        """Return a task's status; its times were not measured."""
        return structs.replace(super().snapshot(i), jitter=[])

    def status(self) -> CoreStatus:
        """Return the dispatcher's status."""
        return structs.replace(super().status(), backend="inline")


class VirtualTables(Tables):
    """Tables that this process alone can open, each the same for all RTPUs."""

    def __init__(self, world: SharedState, *, changed: Callable[[], None]) -> None:
        super().__init__(world.domain, changed=changed)
        self._world = world

    def need_file(self, subsystem: str) -> Opened:
        """Return the subsystem's table."""
        return self.need(subsystem)

    def close(self, subsystem: str) -> None:
        """Let go of the table."""
        if opened := self._open.pop(subsystem, None):
            if opened.use.keep:
                self._world.tables.pop(opened.table.name, None)
            self._changed()

    def _create(self, name: str, file: SvarFile) -> Table:
        table = self._world.tables.get(name)
        if table is None:
            table = self._world.tables[name] = Table.create(name, file.variables)
            table.path.unlink()
            table.virtual = lambda: self._world.loop.now_ns
        return table

    def _attach(self, name: str, file: SvarFile) -> Table:
        return self._create(name, file)


class VirtualOverview(SharedMemoryStatus):
    """An agent's knowledge of its RTPU.

    Args:
        rtpu: The RTPU.
    """

    def __init__(self, rtpu: VirtualRtpu) -> None:
        def note(note: rtpu_messages.Note) -> None:
            rtpu.events.add(Severity(note.severity), note.code, note.text)

        super().__init__(rtpu.config.domain, rtpu.name, note, lambda _: None)
        self._state = rtpu
        self._core = rtpu.core
        self._snapshots = rtpu_snapshot.SnapshotPublisher(rtpu)

    def refresh(self) -> None:
        """Process changes."""
        tables = self._state.tables
        opened = {name: tables.need(name) for name in tables.subsystems()}
        self._tables = {name: (one.table, one.use.keep) for name, one in opened.items()}
        if news := self._snapshots.news():
            self.learn(msgspec.msgpack.decode(news, type=rtpu_snapshot.SnapshotChanges))


class VirtualSpawner(Spawner):
    """Makes tasks in this process.

    Args:
        rtpu: Whose.
    """

    def __init__(self, rtpu: VirtualRtpu) -> None:
        super().__init__(rtpu.config.core, None, lambda _: None)
        self._rtpu = rtpu

    async def fork(self, kind: str, title: str, spec: msgspec.Struct) -> Child:
        """Return the substitute for the process of a task or an inspector."""
        del kind, title
        world = self._rtpu.world
        near, far = pair(world.loop)
        child = VirtualChild(world.number(), near)
        if isinstance(spec, rtpu_messages.InspectSpec):
            child.left = rtpu_messages.encode(inspect(world.library, spec.name))
            child.exited.set_result(0)
        elif isinstance(spec, rtpu_messages.TaskSpec):
            host = VirtualTask(self._rtpu, spec, child, far)
            self._rtpu.hosts[spec.slot] = host
            world.loop.call_soon(host.begin)
        return child


class VirtualChild(Child):
    """Stands for the process of a task.

    Args:
        pid: Another number for each.
        sock: The channel to it.
    """

    def __init__(self, pid: int, sock: Channel) -> None:
        self.pid, self.started = pid, 0
        self.sock = cast("socket.socket", sock)
        self.out = -1
        self.left = b""
        self.exited = asyncio.get_running_loop().create_future()

    def crash_text(self) -> str:
        """Return nothing: it cannot crash by itself."""
        return ""

    def result(self) -> bytes:
        """Return what an inspector has found."""
        return self.left

    def send_signal(self, which: signal.Signals) -> None:
        """Do nothing: what hangs here has this process hang."""

    def core_wait(self) -> CoreWait:
        """Return what counts nothing: virtual time waits while others compute."""
        return CoreWait(0)

    def close(self) -> None:
        """Close the channel."""
        self.sock.close()


class VirtualTask(Host):
    """A task in this process: what `Host` is, but for the process.

    Args:
        rtpu: Its RTPU.
        spec: What it is to be.
        child: Stands for its process.
        channel: Leads to its RTPU.
    """

    def __init__(
        self,
        rtpu: VirtualRtpu,
        spec: rtpu_messages.TaskSpec,
        child: VirtualChild,
        channel: Channel,
    ) -> None:
        super().__init__(spec, RtpuChannel(channel), rtpu.core)  # type: ignore[arg-type]
        self._rtpu, self._child, self._channel = rtpu, child, channel
        self._made = self._stands = False
        self._batch = self._left = 1
        self._cycles = 0
        self.drain: Callable[[], None] = lambda: None
        """Takes what is in the ring."""
        self.recorded = False
        """Whether a recorder has the ring, and closes it."""

    @property
    def cycles(self) -> int:
        """Cycles executed since the task was spawned."""
        return self._cycles if self._over else self.slot.cycles

    def create(self) -> None:
        """Load the module, bind it to the table, and run its `init`.

        Raises:
            NodeError: It is of a type that cannot be simulated.
            PbonetError: As of any task.
        """
        rmod = parse_rmod(self.spec.rmod, self.spec.rmod_name)
        kind, simulated = rmod.tasktype, self._rtpu.world.simulated
        timed = self.spec.freq or kind is TaskType.BACKGROUND
        if kind not in simulated or not timed:
            raise NodeError(
                f"a {kind} task cannot be simulated",
                where=rmod.file,
                expected=f"{' or '.join(simulated)}, with FREQ or PERIOD",
                got=f"TASKTYPE {kind}",
                remedy="run it in real time",
            )
        super().create()

    def begin(self) -> None:
        """Create the task, and report the result."""
        with running(None), using(None):
            try:
                self.create()
            except PbonetError as error:
                done = rtpu_messages.Done(
                    n=0, state=State.NOT_CREATED, error=error.to_wire()
                )
                self.to_rtpu.say(done)
                self._over = True
                self._close()
            else:
                self._made = True
                self.ready([])

    def attend(self) -> None:
        """Carry out the messages that wait."""
        if not self._made or self._over or not self._channel.waits:
            return
        with self._awake():
            if self._stands:
                self._stands = False
                self.slot.disarm()
            self._take()
            self._go_on()

    def run(self) -> None:
        """Run the cycle, or come on, as the dispatcher has granted."""
        with self._awake():
            if self._stands:
                self._stands = False
                self._engage()
            self._go_on()
            self._left -= 1
            if self._left <= 0:
                self._left = self._batch
                self.drain()

    def _go_on(self) -> None:
        """Do the work of this instant."""
        while self.executor.state is State.ON and self._cycle() != rt.IDLE:
            pass
        if self._over:
            self._close()
        elif (
            self.executor.state is State.OFF and self.predecessors and not self._stands
        ):
            self._stands = True
            self.slot.stand_by()

    @contextmanager
    def _awake(self) -> Generator[None]:
        """Run the block as the task, which owns what is opened there."""
        self.local.virtual_ns = self._rtpu.now_ns()
        with running(None), using(self.tape):
            yield

    @property
    def outside(self) -> bool:
        """Whether `sync` determines the release; in virtual time the rate does."""
        return False

    # -- in the place of a process -----------------------------------------------------

    def open_core(self, number: int) -> VirtualCore:
        """Return the table of a core."""
        return self._rtpu.world.cores[number]

    def library(self) -> Library:
        """Return the library that has the module."""
        return self._rtpu.world.library

    def attach(self) -> Table:
        """Return the subsystem's table."""
        return self._rtpu.tables.need(self.spec.subsystem).table

    def live_in_process(self) -> None:
        """Do nothing: this process is that of many tasks."""

    def seed(self) -> int:
        """Return the seed that this task has in every simulation."""
        return self._rtpu.world.seed(f"{self.spec.subsystem}/{self.spec.task}")

    def record(self, told: TaskAbout) -> Ring:
        """Return a ring that no other process can open."""
        room = ring_bytes(told)
        ring = Ring.create(self.spec.ring, room)
        Path(ring.path).unlink()
        self._batch = max(1, room // (4 * record_bytes(told)))
        self.ring = ring
        self._rtpu.world.record(self, told)
        return ring

    def _tidy(self) -> None:
        """Leave this process's garbage to its collector."""

    def _close(self) -> None:
        """Leave everything, as a process does that ends."""
        for name in ("alarm", "local"):
            held = getattr(self, name, None)
            if held is not None:
                (held.end if name == "alarm" else held.close)()
        self.slot.disarm()
        self.drain()
        self.drain = lambda: None
        if not self.recorded and hasattr(self, "ring"):
            self.ring.close()
        self._cycles = self.slot.cycles
        del self._rtpu.hosts[self.spec.slot]
        self._child.exited.set_result(0)
        self._channel.close()
