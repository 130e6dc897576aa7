"""All that an RTPU process holds: claims, tables, tasks, core table, dispatcher."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections import Counter, deque
from typing import TYPE_CHECKING

import pbonet
from pbonet.analysis.schedule import CoreShare, Mode
from pbonet.config import RtpuEntry, Scheduler, TaskType
from pbonet.errors import PbonetError, RealTimeError, Severity
from pbonet.node import rt
from pbonet.node.task import INTERRUPT, own_place, placed
from pbonet.node.wire import (
    ask_neighbours,
    cpu_idle_states,
    describe_end,
    lifecycle,
    process_setup,
    rtpu_messages,
)
from pbonet.pbo import Signal, State

from . import (
    cleanup,
    ranking,
    rtpu_snapshot as known,
    status,
)
from .claims import Claims
from .constant_owners import ConstantOwners
from .fallbacks import Fallbacks
from .fork_client import LARGEST_CROWD, Server, Spawner
from .illegal_flag import Flags
from .orphaned_rings import let_ring_go, ring_damage
from .scheduling_check import SchedulingCheck
from .successors import Successors
from .tables import Tables
from .task_handle import crash_place
from .task_signals import RepeatedWarnings, Signals
from .timing_failure_events import TimingFailureEvents
from .waiting_cycles import WaitingCycles

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from pbonet.analysis.schedule import SlotStatus
    from pbonet.node.wire import EventLog, Neighbours
    from pbonet.xm.net import Call, TaskStatus, run_folder

    from .task_handle import Task

Key = tuple[str, str]
"""Subsystem and task."""
_ON = (Mode.ON, Mode.COMMAND)
_CRASHES = frozenset(
    -number
    for number in (
        signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE
    )
)  # fmt: skip
"""Exit codes of a process that its own code has ended."""
"""Modes of a task that is ON: between cycles, or at a command."""
MOST_STOPS = 64
"""Stop orders that an RTPU remembers."""
WATCH_PERIOD = 0.5
"""Seconds between checks of what is not reported: lost files, the dispatcher."""
GLANCE = 0.005
"""Seconds between checks for a writer, while the flag is up for lack of one."""


class Rtpu:
    """The state of one RTPU process.

    Args:
        config: The settings from its agent at its start.
        events: Takes reports of what happens.
        places: Its files in the runtime folder.
        forks: The fork server that its process began with; in virtual time None.
    """

    obey: Callable[[Task, str, str], None] | None = None
    """Carries out a signal that a task's module sends to another task; never waits."""
    _budget: ranking.CoreBudget | None = None
    """Of its core; None in virtual time."""
    _scheduling: SchedulingCheck
    agent_pid = 0
    """The agent that uses it now; 0: none."""
    locks_memory = True
    """Whether the kernel lets this process and its tasks lock their memory."""

    def __init__(
        self,
        config: rtpu_messages.RtpuConfig,
        events: EventLog,
        places: run_folder.Places,
        forks: Server | None,
    ) -> None:
        self.config = config
        self.events = events
        events.state_of = self._state_of
        self.places = places
        self.name = config.name
        self.slot_owner = f"{config.domain}/{config.name}"
        self.claims = Claims(config.name, epoch=time.time_ns() // 1_000_000)
        self.tables = self._open_tables()
        self.flags = Flags(config.name, self.tables, events)
        self.tasks: dict[Key, Task] = {}
        self.rings: set[str] = set()
        """Rings of the tasks, and of those that are being created."""
        self.tombs: dict[Key, TaskStatus] = {}
        """The last status of tasks that died or were ended by force while they were ON,
        until they are killed (again) or respawned."""
        self.told: dict[Key, tuple[int | None, int]] = {}
        """Criticality and priority as the master gave them."""
        self.spawned: dict[Key, tuple[int | None, int]] = {}
        """The same, as they came with the spawn."""
        self.ranks: dict[Key, ranking.Ranked] = {}
        self.recordings: dict[str, rtpu_messages.Recording] = {}
        """Recordings that the agent is to make, by subsystem."""
        self.stopping: set[str] = set()
        self.times_stopped: Counter[str] = Counter()
        """How often each subsystem was stopped: a spawn under way must know."""
        self.stops: deque[str] = deque(maxlen=MOST_STOPS)
        """Stop orders that were carried out."""
        self._started_ns = time.monotonic_ns()
        self.lists: dict[str, list[tuple[str, str]]] = {}
        """Lists of signals that are being carried out, by subsystem."""
        self._chores: set[asyncio.Task[None]] = set()
        self.turned_on = 0
        self.signals = Signals(events)
        self.warnings = RepeatedWarnings(events)
        self._timing_failures = TimingFailureEvents(events)
        self._waiting_cycles = WaitingCycles(events)
        self.spawner = self._make_spawner(forks)
        self.core: rt.CoreTable
        self.dispatcher: rt.Dispatcher
        self.vigil: rt.Vigil
        self.fallbacks = Fallbacks(self)
        self.successors = Successors(self)
        self.owned_constants = ConstantOwners(self)
        self.limits: list[str] = []
        self._watch: asyncio.Task[None] | None = None
        self._awake: cpu_idle_states.IdleStateLock | None = None
        self.claims_changed: Callable[[], None] | None = None
        self.call_far: Callable[[str, list[Call]], None] | None = None
        """Lets successors on other machines be called."""
        self.changed: Callable[[], None] | None = None
        """Called when something that `rtpu_snapshot` reports may have changed."""

    def _open_tables(self) -> Tables:
        return Tables(self.config.domain, changed=self.publish_claims)

    def _make_spawner(self, forks: Server | None) -> Spawner:
        return Spawner(self.config.core, forks, self._forks_died)

    def now_ns(self) -> int:
        """Return the time in which the tasks live."""
        return time.monotonic_ns()

    async def start(self) -> None:
        """Take the core, start dispatching, start the fork server.

        Raises:
            PbonetError: One of these is not possible.
        """
        probe = rt.probe()
        self.limits = list(probe.reasons)
        if self.config.core not in probe.cores:
            raise RealTimeError(
                f"core {self.config.core} cannot be used by this process",
                where=self.name,
                expected="one of " + " ".join(map(str, probe.cores)),
                remedy="choose another core, leave --core out to have one chosen, or "
                "widen the process's CPU affinity",
            )
        os.sched_setaffinity(0, process_setup.housekeeping_cores(self.config.core))
        try:
            rt.lock_memory()
        except RealTimeError as error:
            if probe.lock_memory:  # else it is among the reasons already
                self.limits.append(f"memory is not locked: {error}")
        self.locks_memory = probe.lock_memory
        await self.spawner.start()
        if self.config.awake:
            self._awake = cpu_idle_states.IdleStateLock()
            self.limits += self._awake.limits
        self.core = rt.CoreTable(self.config.core, member=True)
        self._scheduling = SchedulingCheck(self.core, self.events)
        self.dispatcher = rt.Dispatcher(self.core, self.config.backend)
        self.dispatcher.start()
        below = self.dispatcher.backend == "fifo"
        wanted = self.config.core_share
        self._budget = ranking.CoreBudget(probe, wanted, below=below)
        if below and wanted is not None and wanted > probe.share:
            self.limits.append(
                f"core_share is {wanted:.1%}, but real-time tasks get {probe.share:.1%}"
                f" of a core ({probe.share_reason}): the critical set is not kept above"
            )
        self.vigil = rt.Vigil(self.dispatcher)
        self.save()
        self._watch = asyncio.create_task(self._watch_quietly(), name="watch")

    async def close(self) -> None:
        """Give everything back; tasks should have ended."""
        waiting = [*self._chores, *([self._watch] if self._watch else [])]
        for one in waiting:
            one.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        if self._awake is not None:
            self._awake.close()
        self.tables.close_all()
        await self.spawner.close()
        for name in ("vigil", "dispatcher", "core"):
            held = getattr(self, name, None)
            if isinstance(held, rt.Dispatcher | rt.Vigil):
                held.stop()
            elif isinstance(held, rt.CoreTable):
                held.close()

    def info(self) -> rtpu_messages.RtpuInfo:
        """Return the identity of this process."""
        share = self.core_share()
        return rtpu_messages.RtpuInfo(
            pid=os.getpid(),
            core=self.config.core,
            version=pbonet.__version__,
            backend=self.dispatcher.backend,
            limits=self.limits,
            share=share.share,
            dispatch=share.dispatch,
            share_reason=share.reason,
            claims=self.claims.epochs(),
            started_ns=self._started_ns,
            stops=list(self.stops),
            tables=self.tables.uses(),
            recordings=self.recordings,
            standbys=self.fallbacks.away(),
        )

    def save(self) -> None:
        """Write down what has to be cleaned away should this process be killed."""
        state = cleanup.Leftovers(
            pid=os.getpid(),
            started=process_setup.start_time(os.getpid()),
            core=self.config.core,
            epoch=self.claims.epoch,
            tables=self.tables.names(),
            tasks=[
                cleanup.TaskLeft(t.child.pid, t.child.started)
                for t in self.tasks.values()
            ],
            rings=sorted(self.rings),
            mark=process_setup.mark(),
            agent_pid=self.agent_pid,
            agent_started=process_setup.start_time(self.agent_pid),
        )
        try:
            cleanup.write(self.places.state, state)
        except PbonetError as error:
            self.events.add(Severity.ERROR, error.code, str(error))

    def publish_claims(self) -> None:
        """Write down and pass on that claims or tables have changed."""
        self.save()
        if self.claims_changed is not None:
            self.claims_changed()

    async def ask_neighbours(
        self, order: rtpu_messages.Order, limit: float
    ) -> Neighbours:
        """Have the RTPU of this machine that has a task carry out a signal for it."""
        return await ask_neighbours(self.places, order, limit)

    def later(self, chore: Coroutine[None, None, None], name: str) -> None:
        """Do something that no request waits for."""
        running = asyncio.create_task(chore, name=name)
        self._chores.add(running)
        running.add_done_callback(self._chores.discard)

    # -- tasks -------------------------------------------------------------------------

    def _state_of(self, subsystem: str, name: str) -> str:
        task = self.tasks.get((subsystem, name))
        return State.NOT_CREATED if task is None else task.state

    def of(self, subsystem: str) -> list[Task]:
        """Return the tasks of a subsystem, in the order in which they were spawned."""
        return [task for key, task in self.tasks.items() if key[0] == subsystem]

    def busy(self) -> set[str]:
        """Return the subsystems that have tasks here."""
        return {subsystem for subsystem, _ in self.tasks}

    def need(self, subsystem: str, name: str) -> Task:
        """Return a task.

        Raises:
            UnknownTaskError: There is none of that name.
        """
        task = self.tasks.get((subsystem, name))
        if task is not None:
            return task
        names = [task.name for task in self.of(subsystem)]
        tomb = self.tombs.get((subsystem, name))
        raise known.no_task(self.name, subsystem, name, names, tomb)

    def rank(self, *joining: Task) -> None:
        """Rank all tasks again and pass what has changed to the dispatcher.

        Args:
            joining: Tasks that are about to be turned on; they count already. One that
                stands by takes nothing from the others.
        """
        wishes = [
            self._wish(key, task, on=task in joining or task.state is State.ON)
            for key, task in self.tasks.items()
        ]
        ranked = ranking.rank(self._entry(), wishes, self.core_share())
        before, self.ranks = self.ranks, {k: ranked["/".join(k)] for k in self.tasks}
        for key, rank in self.ranks.items():
            if before.get(key) != rank:
                slot = self.tasks[key].facts.slot
                self.core.configure(
                    slot, crit=rank.crit, priority=rank.priority, drop=rank.drop
                )

    def core_share(self) -> CoreShare:
        """Return what the tasks may use of the core; all of it in virtual time."""
        return CoreShare() if self._budget is None else self._budget.share()

    def _entry(self) -> RtpuEntry:
        """Return the combined descriptions of the RTPU by its users."""
        entries = [self.claims.get(subsystem) for subsystem in self.busy()]
        known = [entry for entry in entries if entry is not None]
        if not known:
            return RtpuEntry(name=self.name)
        return RtpuEntry(
            name=self.name,
            scheduler=Scheduler(known[0].scheduler),
            minfreq=min(entry.minfreq for entry in known),
            maxfreq=max(entry.maxfreq for entry in known),
        )

    def _wish(self, key: Key, task: Task, *, on: bool) -> ranking.RankRequest:
        crit, priority = self.spawned.get(key, (None, 0))
        return ranking.RankRequest(
            name="/".join(key),
            rmod=task.facts.rmod,
            freq=task.freq,
            on=on,
            told=self.told.get(key),
            spawn_crit=crit,
            priority=priority,
        )

    def status_of(self, task: Task) -> TaskStatus:
        """Return a task's status from shared memory."""
        slot = self.core.snapshot(task.facts.slot)
        signals = self.core.signals(task.facts.slot)
        return status.task_status(self.name, known.of(self, task), slot, signals)

    def cycle_of(self, task: Task) -> int:
        """Return how many cycles a task has completed since it was turned on."""
        if task.last_status is not None:  # its slot may be another one's
            return task.last_status.cycle
        slot = self.core.snapshot(task.facts.slot)
        return slot.cycles - slot.on_cycles

    def watch_life(self, task: Task) -> None:
        """Report the task's death, or its change to ERROR, at once.

        If a cycle of it fails in time, the dispatcher writes its safe values.
        """
        self._timing_failures.begin(self.core.status())
        opened = self.tables.get(task.facts.subsystem)
        depended_on = opened is not None and task.facts.outputs
        self.vigil.watch(
            task.facts.slot,
            opened.table.arena if opened is not None and depended_on else None,
            f"{self.name}/{task.name}".encode(),
            f"{task.name} has died".encode(),
            f"{task.name} is in ERROR".encode(),
        )
        values = task.ready.safe if task.ready is not None else b""
        if values and opened is not None:
            self.dispatcher.keep_values(task.facts.slot, opened.table.arena, values)

    def unwatch_life(self, task: Task) -> None:
        """Forget a task whose process has ended."""
        self.vigil.forget(task.facts.slot)
        self.dispatcher.drop_values(task.facts.slot)

    # -- what happens unasked ----------------------------------------------------------

    def notify_changed(self) -> None:
        """Note that a task has sent something, or has ended."""
        if self.changed is not None:
            self.changed()

    def take_notice(self, task: Task, notice: rtpu_messages.Notice) -> None:
        """Process a task's report: an event, and perhaps an error or a warning."""
        severity = Severity(notice.severity)
        for code, count in notice.lost.items():
            where = task.facts.subsystem
            self.events.count(code, count, subsystem=where, task=task.name)
        if notice.lost and notice.code != "LOST":
            lost = sum(notice.lost.values())
            notice.text = f"[{lost} notices lost before this one] {notice.text}"
        _remember(task, notice)
        if notice.order is not None and self.obey is not None:
            self.obey(task, *notice.order)
        if notice.code == "ENDING" and task.state is State.ON:
            self._leaves(task)
        if notice.code == "ENGAGED":
            self._engaged(task, notice)
        elif notice.state:
            self.settle(task)
        if self.warnings.repeats(task, notice, self.now_ns()):
            self.signals.reported(task, notice.bits)
            return
        goes_on = notice.state in {"", State.ON}  # a flood at worst, no change of state
        if goes_on and not task.budget.take(self.now_ns()):
            where = task.facts.subsystem
            self.events.count(notice.code, subsystem=where, task=task.name)
            return
        self.signals.reported(task, notice.bits)
        if held := task.budget.take_suppressed():
            notice.text = f"[{held} notices held back before this one] {notice.text}"
        self.events.add(
            severity,
            notice.code,
            notice.text,
            subsystem=task.facts.subsystem,
            task=task.name,
            cycle=notice.cycle,
            bits=notice.bits,
            errnum=notice.errnum,
            place=notice.place,
        )
        self.flags.report()

    def _leaves(self, task: Task) -> None:
        """Raise the flag for a task that ends unasked; it still owns its variables."""
        task.left = True
        if task.facts.outputs:
            cause = f"{task.name} has ended by itself"
            self.flags.up(task.facts.subsystem, task.name, cause)

    def _engaged(self, task: Task, notice: rtpu_messages.Notice) -> None:
        """Note that the dispatcher has turned a task ON."""
        if task.state is State.ON:
            self.turned_on += 1
            task.on_rank = self.turned_on
        subsystem, replaced = task.facts.subsystem, task.stands_by
        self.fallbacks.engaged(task, notice)
        original = self.tasks.get((subsystem, replaced))
        if original and self.flags.written(subsystem, self.fallbacks.missed(original)):
            self.flags.down(subsystem, replaced)
        self.settle(task)
        self.flags.evaluate()

    def settle(self, task: Task, *, ranked: bool = False) -> None:
        """Bring ranks, error text and the flag in line with a task's state."""
        if not ranked:
            self.rank()
        if task.state is State.ERROR:
            self._raise_flag(task, "is in ERROR")
        else:
            task.error = ""
            if not (task.left or task.gone.is_set()):
                self.flags.down(task.facts.subsystem, task.name)
        self.fallbacks.update(task)

    def _raise_flag(self, task: Task, how: str) -> None:
        """Raise the flag for a task if others may depend on it."""
        outputs, subsystem = self.fallbacks.missed(task), task.facts.subsystem
        if outputs and not self.flags.written(subsystem, outputs):
            cause = f"{task.name} {how}"
            self.flags.up(subsystem, task.name, cause, outputs)
        else:  # the vigil may have raised it, and a fallback is there already
            self.flags.down(subsystem, task.name)

    def ended(self, task: Task, code: int) -> None:
        """Clean up after a task's process, however it ended."""
        task.last_status = self.status_of(task)
        self.signals.end(self.core, task)
        self.warnings.end(task, self.now_ns())
        self.unwatch_life(task)
        self.core.died(task.facts.slot)
        # After the mark: from here on callers learn that no successor comes.
        slot = self.core.snapshot(task.facts.slot)
        self._timing_failures.report_end(task, slot)
        self.core.free(task.facts.slot)
        for kept in (self.tasks, self.told, self.spawned):
            kept.pop((task.facts.subsystem, task.name), None)
        # The flag is up before the task's own entries go.
        if not task.stopping or _crashed_at_its_end(task, code):
            self._died(task, code, slot)
        elif slot.mode in _ON and task.facts.subsystem not in self.stopping:
            self._leave_tomb(task, "the task was ended by force while it was ON")
            self._raise_flag(task, "has died")
        else:
            self.flags.down(task.facts.subsystem, task.name)
        self._reap(task)
        self.fallbacks.update(task)
        self.rank()
        self.save()

    def _reap(self, task: Task) -> None:
        """Free what a dead task held in shared memory."""
        opened = self.tables.sound(task.facts.subsystem)
        try:
            if opened is not None:
                opened.table.reap(task.name)
            let_ring_go(task, self.recordings.get(task.facts.subsystem))
            self.rings.discard(task.facts.ring)
        except (PbonetError, OSError) as error:
            self.events.add(Severity.ERROR, "INTERNAL", f"after {task.name}: {error}")

    def _died(self, task: Task, code: int, slot: SlotStatus) -> None:
        """Report a task that ended unasked, and remember its last status."""
        text = f"the task ended by itself: {describe_end(code)}"
        if code == -signal.SIGBUS:
            if damage := self.tables.damage(task.facts.subsystem):
                text = f"the task ended with its table: {damage}"
            elif damage := ring_damage(task):
                text = f"the task ended with its ring: {damage}"
        text = task.blame or text
        if slot.hangs:
            text = (
                "the task ended itself: timing_failure() did not return, not even when "
                "it was aborted"
            )
        last = self._leave_tomb(task, text)
        last.signals["ERROR"] += 1
        was_on = slot.mode is not Mode.OFF or task.busy == lifecycle.Event.ON
        if was_on or slot.comes:
            self._raise_flag(task, "has died")
        elif task.left:
            self._raise_flag(task, "has ended by itself")
        trace = task.child.crash_text()
        self.events.add(
            Severity.ERROR,
            "TASK_DIED",
            f"{text}\n{trace}" if trace else text,
            subsystem=task.facts.subsystem,
            task=task.name,
            cycle=last.cycle,
            bits=int(Signal.ERROR),
            place=own_place(trace) or crash_place(trace),
        )

    def _leave_tomb(self, task: Task, text: str) -> TaskStatus:
        """Keep the last status of a task that did not end in order, and return it."""
        task.ending = text
        last = task.last_status or self.status_of(task)
        last.error, last.tid = text, 0
        self.tombs[task.facts.subsystem, task.name] = last
        return last

    def _end_crowds(self) -> None:
        """End tasks that start processes without end; their death names the cause."""
        crowds = self.spawner.crowds()
        for task in self.tasks.values():
            count = crowds.get(task.child.pid, 0)
            if count and not task.blame:
                task.blame = (
                    f"module {task.facts.rmod.module} has started {count} processes "
                    f"(expected at most {LARGEST_CROWD} at a time), and was ended with "
                    "them"
                )
                task.child.send_signal(signal.SIGKILL)

    def bury(self, subsystem: str, name: str) -> None:
        """Forget a task that died, and what was raised for it."""
        self.tombs.pop((subsystem, name), None)
        self.flags.down(subsystem, name)

    def forget(self, subsystem: str) -> None:
        """Forget all tasks of a subsystem that died."""
        for key in [key for key in self.tombs if key[0] == subsystem]:
            self.bury(*key)
        self.fallbacks.forget(subsystem)
        self.flags.decided(subsystem)

    def _forks_died(self, code: int) -> None:
        self.events.add(
            Severity.ERROR,
            "FORK_SERVER_DIED",
            f"the fork server ended: {describe_end(code)}; every task "
            "turns itself off and ends",
        )
        for task in self.tasks.values():
            if task.facts.rmod.tasktype is not TaskType.PERIODIC:
                task.child.rouse(INTERRUPT)  # it may wait in `sync`

    async def _pause(self) -> None:
        """Wait for the watch's next round; meanwhile lower the flag promptly.

        The task that writes what was missing may be on another RTPU.
        """
        loop = asyncio.get_running_loop()
        end = loop.time() + WATCH_PERIOD
        while (left := end - loop.time()) > 0.0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await self.flags.waits.wait()
                await asyncio.sleep(GLANCE)
                self.flags.evaluate_if_changed()

    async def _watch_quietly(self) -> None:
        """Check what is not reported."""
        led = True
        while True:
            await self._pause()
            self.core.reap()
            self.flags.evaluate()
            self.owned_constants.check()
            self.fallbacks.update_all()
            self.signals.report_missing(self.core, self.tasks.values())
            self.warnings.report(self.now_ns())
            tasks = [
                (task, self.core.snapshot(task.facts.slot))
                for task in self.tasks.values()
            ]
            core = self.core.status()
            self._timing_failures.report_new(core, tasks)
            if self._budget and self._budget.update(core, self.core.cpu_ns()):
                self.publish_claims()  # with what is left for tasks
            if any(slot.in_sync and slot.mode is Mode.ON for _, slot in tasks):
                self.core.kick()  # in its turns it reads what waits have used
            self._waiting_cycles.check(tasks)
            self._scheduling.check(tasks)
            if tasks:
                self._end_crowds()
            for subsystem, damage in self.tables.harmed():
                self.events.add(
                    Severity.ERROR,
                    "TABLE_DAMAGED" if damage else "TABLE_REMOVED",
                    damage or "the table's file was removed; running tasks continue",
                    subsystem=subsystem,
                )
            self.notify_changed()
            if led and not self.dispatcher.running:
                led = False
                self.events.add(
                    Severity.FATAL, "DISPATCHER_ENDED", "no tasks are released any more"
                )


def _crashed_at_its_end(task: Task, code: int) -> bool:
    """Return whether a task was to end, but crashed instead, after its `init`."""
    return task.ready is not None and code in _CRASHES


def _remember(task: Task, notice: rtpu_messages.Notice) -> None:
    """Keep the last warning and the last error of a task, for its status."""
    if notice.code == "WARNING":
        task.warnings += 1
        task.warning = notice.text
    if notice.error is not None:
        error = str(PbonetError.from_wire(notice.error))
        task.error = placed(error, notice.place)
