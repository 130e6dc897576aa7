# cython: language_level=3, boundscheck=False, wraparound=False, freethreading_compatible=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = layout.h muf.h dispatch.h sys.h table.h loop.h slot.h view.h ring.h guard.h _rt_process.pxi
"""Thin skin over the C headers of this folder; `_rt.pyi` says what everything does."""

import os

from cpython.exc cimport PyErr_CheckSignals
from libc.errno cimport EACCES, ENOSPC, EPERM
from libc.stdint cimport int32_t, int64_t, uint32_t, uint64_t
from libc.stdlib cimport free, malloc
from libc.string cimport memset, strdup

from pbonet.errors import NodeError, RealTimeError
from pbonet.node import _ring, rights
from pbonet.node._ring cimport RING_STABLE, Ring, ring_put, ring_record
from pbonet.node._rt_headers cimport *
from pbonet.sched.histogram import octaves
from pbonet.sched.records import CoreStatus, Decision, Histograms, Kind, Mode, SlotStatus
from pbonet.svar._svar cimport LocalTable

COMMAND = RT_WAIT_COMMAND
ORPHAN = RT_WAIT_ORPHAN
FLAGS = 3
SLOTS = RT_SLOTS
MIN_PERIOD_NS = RT_MIN_PERIOD_NS
COMMAND_LEVEL = RT_COMMAND_LEVEL
DISPATCHER_LEVEL = RT_DISPATCHER_LEVEL
LEAVE = 8 | 16 | 32 | 64
globals().update(Ring=_ring.Ring, Record=_ring.Record)  # a cimported name is C's alone
_BACKENDS = {RT_NONE: "", RT_FIFO: "fifo", RT_PARK: "park"}

cdef enum:
    COPY_TORN = 1
    COPY_STALE = 2
    COPY_FLAGS = 15


def _path(str name) -> str:
    folder = os.environ.get("PBONET_SHM_DIR", "/dev/shm")
    return os.path.join(folder, f"pbonet.{os.geteuid()}.{name}")


cdef _refuse(int error, str path):
    """Raise what an answer of rt_attach means."""
    if error == RT_NO_TABLE:
        raise NodeError("the core has no table", where=path,
                        remedy="start an agent for this core first")
    if error == RT_FOREIGN:
        raise RealTimeError("the core table belongs to somebody else", where=path,
                            expected="a file of this user with mode 0600",
                            remedy="find out who made it and remove it")
    if error == RT_BAD_VERSION:
        raise NodeError("the core table is of another version of pbonet", where=path,
                        expected=f"version {RT_VERSION}",
                        remedy="stop the agents of the other version on this core")
    if error == RT_DAMAGED:
        raise NodeError("the core table is damaged", where=path,
                        remedy="restart the agents of this core")
    if error == RT_MEMBERS_FULL:
        raise NodeError("too many RTPUs share this core", where=path,
                        expected=f"at most {RT_MEMBERS}")
    if error == ENOSPC:
        raise RealTimeError("shared memory is full", where=path,
                            expected=f"{sizeof(rt_table)} bytes",
                            remedy="free space there, or set PBONET_SHM_DIR")
    raise RealTimeError(f"the core table cannot be opened: {os.strerror(error)}",
                        where=path)


cdef class CoreTable:
    cdef rt_map map
    cdef rt_table *t
    cdef char *file
    cdef readonly int core
    cdef readonly str path
    cdef readonly bint member
    cdef int busy           # dispatchers of this process that run on it

    def __cinit__(self, int core, *, bint member=True):
        self.core = core
        self.member = member
        self.path = _path(f"core{core}")
        cdef int error
        self.file = strdup(os.fsencode(self.path))
        with nogil:
            error = rt_attach(&self.map, self.file, core, member)
        if error:
            _refuse(error, self.path)
        self.t = self.map.table

    def close(self) -> None:
        if self.busy:
            raise NodeError("the core table is in use", where=self.path,
                            remedy="stop the dispatcher first")
        if self.t is not NULL:
            self.t = NULL
            rt_detach(&self.map, self.file)

    def __dealloc__(self):
        if self.t is not NULL:
            rt_detach(&self.map, self.file)
        free(self.file)

    cdef rt_table *open(self) except NULL:
        if self.t is NULL:
            raise NodeError("the core table is closed", where=self.path)
        return self.t

    cdef rt_slot *slot(self, int i) except NULL:
        self.open()
        if not 0 <= i < RT_SLOTS or not rt_life(self.t, i) & 1:
            raise NodeError(f"slot {i} is not in use", where=self.path)
        return &self.t.slots[i]

    def alloc(self, str rtpu, str task) -> int:
        cdef bytes r = rtpu.encode(), n = task.encode()
        if max(len(r), len(n)) >= RT_NAME:
            raise NodeError("the name is too long", where=f"{rtpu}/{task}",
                            expected=f"at most {RT_NAME - 1} bytes")
        self.open()
        if not self.member:
            raise NodeError("only a member of the core takes slots", where=self.path,
                            remedy="open the table with member=True")
        cdef int i = rt_alloc(self.t, self.map.member, r, n)
        if i < 0:
            raise NodeError("all slots of the core are taken", where=self.path,
                            expected=f"at most {RT_SLOTS} tasks",
                            remedy="kill tasks, or use another core")
        rt_kick(self.t)
        return i

    def free(self, int i) -> None:
        self.slot(i)
        rt_free(self.t, i)
        rt_kick(self.t)

    def configure(self, int i, *, pid=None, period_ns=None, deadline_ns=None, crit=None,
                  priority=None, kind=None) -> None:
        cdef rt_slot *slot = self.slot(i)
        cdef rt_settings s = rt_settings(pid=-1, crit=-1, priority=-1, kind=-1,
                                         period_ns=-1, deadline_ns=-1)
        if pid is not None:
            s.pid = _within("pid", pid, 1, 1 << 30)
        if period_ns is not None:
            s.period_ns = _within("period_ns", period_ns, RT_MIN_PERIOD_NS, 1 << 61)
        if deadline_ns is not None:
            s.deadline_ns = _within("deadline_ns", deadline_ns, 0, 1 << 61)
        if crit is not None:
            s.crit = _within("crit", crit, 0, 63)
        if priority is not None:
            s.priority = _within("priority", priority, 0, 65535)
        if kind is not None:
            s.kind = Kind(kind)
            if rt_mode_of(slot) != RT_OFF:
                raise ValueError("the kind of a task changes only while it is OFF")
        rt_configure(self.t, i, &s)
        rt_kick(self.t)

    def request(self, int i) -> None:
        rt_request(self.slot(i), RT_ASK_COMMAND)

    def died(self, int i) -> None:
        self.slot(i)
        rt_died(self.t, i)
        rt_kick(self.t)

    def slots(self, rtpu=None) -> list:
        self.open()
        return [i for i in range(RT_SLOTS) if rt_life(self.t, i) & 1
                and (rtpu is None or self.t.slots[i].config.rtpu.decode() == rtpu)]

    def find(self, str rtpu, str task):
        for i in self.slots(rtpu):
            if self.t.slots[<int>i].config.task.decode() == task:
                return i
        return None

    def snapshot(self, int i):
        cdef rt_slot *slot = self.slot(i)
        cdef rt_view v
        rt_snapshot(slot, &v)
        return SlotStatus(
            index=i, rtpu=slot.config.rtpu.decode(), task=slot.config.task.decode(),
            pid=v.pid, kind=Kind(v.kind), mode=Mode(v.mode), dead=bool(v.dead),
            period_ns=v.period_ns, deadline_ns=v.deadline_ns, crit=v.crit,
            priority=v.priority, level=v.level, errors=v.errors, now_ns=rt_now(),
            on_ns=v.on_ns, release_ns=v.release_ns, cycles=v.cycles,
            missed=v.dispatcher_missed + v.failed, late=v.late, failed=v.failed,
            stable_cycles=v.stable, on_cycles=v.on_cycles, on_missed=v.on_missed,
            on_cpu_ns=v.on_cpu_ns, on_faults=v.on_faults, cpu_total_ns=v.cpu_total_ns,
            cpu_last_ns=v.cpu_last_ns, cpu_min_ns=v.cpu_min_ns, cpu_max_ns=v.cpu_max_ns,
            copy_in_ns=v.copy_in_ns, copy_out_ns=v.copy_out_ns, torn=v.torn,
            stale=v.stale, faults=v.faults, ring_lost=v.ring_lost,
            jitter_max_ns=v.jitter_max_ns,
            jitter=octaves([v.jitter[k] for k in range(RT_BINS)]))

    def histograms(self, int i):
        cdef rt_view v
        rt_snapshot(self.slot(i), &v)
        return Histograms(jitter=[v.jitter[k] for k in range(RT_BINS)],
                          cpu=[v.cpu[k] for k in range(RT_BINS)])

    def status(self):
        cdef rt_core_view v
        rt_core_snapshot(self.open(), &v)
        return CoreStatus(
            core=self.core, backend=_BACKENDS[v.backend], leader_pid=v.leader_pid,
            leader_tid=v.leader_tid, since_ns=v.since_ns, turns=v.turns,
            releases=v.releases, level_changes=v.level_changes, errors=v.errors,
            late_max_ns=v.late_max_ns, takeovers=v.takeovers,
            cpu_ns=_thread_cpu(v.leader_pid, v.leader_tid),
            members=[(v.members[k], bool(v.lives[k])) for k in range(RT_MEMBERS)
                     if v.members[k]])

    def trace(self, uint64_t since=0):
        self.open()
        cdef uint64_t end, first, n, k
        cdef rt_event *copy = <rt_event *>malloc(RT_TRACE * sizeof(rt_event))
        if copy is NULL:
            raise MemoryError
        try:
            n = rt_copy_trace(self.t, since, copy, &first, &end)
            records = [Decision(copy[k].kind, copy[k].slot, copy[k].arg, copy[k].a,
                                copy[k].b) for k in range(n)]
        finally:
            free(copy)
        return end, first - since if first > since else 0, records

    cdef _alone(self):
        if rt_leader(self.open()):
            raise RealTimeError("a dispatcher leads this core", where=self.path,
                                expected="virtual time on a table of its own")

    def step(self, int64_t now_ns, *, bint park=False) -> int:
        self._alone()
        cdef int64_t due = rt_turn(self.t, now_ns, park, 0)
        rt_turn_end(self.t)
        return due

    def post(self, int i, *, mode=None, bint begun=False, bint done=False) -> None:
        self._alone()
        rt_play(self.t, self.slot(i), -1 if mode is None else int(mode), begun, done)


def _within(name, value, low, high):
    if not low <= value <= high:
        raise ValueError(f"{name} {value} is not within {low} to {high}")
    return value


def _thread_cpu(int pid, int tid) -> int:
    """Return a thread's CPU time out of schedstat; 0 when it is gone."""
    try:
        with open(f"/proc/{pid}/task/{tid}/schedstat", encoding="utf-8") as file:
            return int(file.read().split()[0])
    except (OSError, ValueError, IndexError):
        return 0


cdef class Dispatcher:
    cdef rt_loop loop
    cdef readonly CoreTable table
    cdef int pid

    def __init__(self, CoreTable table not None, str backend="auto"):
        table.open()
        if backend not in ("auto", "fifo", "park"):
            raise ValueError(f"backend {backend!r} is not auto, fifo or park")
        if self.loop.running:
            raise NodeError("the dispatcher runs already")
        cdef int error = 0
        if backend != "park":
            error = rt_try_fifo()
        if error and backend == "fifo":
            what, _, remedy = probe().reasons[0].partition("; ")
            raise RealTimeError(what.replace(", timing is soft", ""), remedy=remedy)
        self.table = table
        self.loop.table = table.t
        self.loop.backend = RT_PARK if backend == "park" or error else RT_FIFO
        self.pid = os.getpid()

    def start(self) -> None:
        if self.loop.running:
            return
        self.table.open()
        cdef int error = rt_start(&self.loop)
        if error:
            raise RealTimeError("the dispatcher's thread cannot be started",
                                where=f"core {self.table.core}", got=os.strerror(error),
                                remedy="is the core in this process's affinity mask?")
        self.table.busy += 1

    def stop(self) -> None:
        if self.loop.running and self.pid == os.getpid():
            with nogil:
                rt_stop(&self.loop)
            self.table.busy -= 1

    def __dealloc__(self):
        if self.loop.running and self.pid == os.getpid():
            with nogil:
                rt_stop(&self.loop)

    @property
    def leading(self) -> bool:
        return bool(rt_leading(&self.loop))

    @property
    def running(self) -> bool:
        return bool(self.loop.running)

    @property
    def backend(self) -> str:
        return _BACKENDS[self.loop.backend]


cdef class Slot:
    cdef rt_task task
    cdef rt_cost cost
    cdef readonly CoreTable table
    cdef readonly int index, flags
    cdef int64_t dt_ns
    cdef object dt
    cdef uint64_t cpu_mark, fault_mark

    def __init__(self, CoreTable table not None, int i):
        self.task.table = table.open()
        self.task.slot = table.slot(i)
        self.table = table
        self.index = i
        self.dt_ns = -1
        rt_guard_slot(&self.task)

    def run(self, cycle, LocalTable local, *, stable=None, sync=None, Ring ring=None,
            int leave=LEAVE) -> int:
        cdef int why, served = 0
        cdef bint synchronous = rt_kind_of(self.live()) == RT_SYNCHRONOUS
        if synchronous != (sync is not None):
            raise ValueError("synchronous tasks, and only they, need `sync`")
        rt_arm(&self.task)
        self.cpu_mark = rt_thread_cpu()
        self.fault_mark = rt_faults()
        try:
            while True:
                with nogil:
                    why = rt_wait(&self.task, served)
                if why == RT_WAIT_SIGNAL:
                    PyErr_CheckSignals()
                elif why != RT_RELEASED:
                    return why
                else:
                    served = 1
                    if synchronous:
                        sync()
                    self.once(cycle, local, stable, ring, leave)
                    if self.flags & leave:
                        return FLAGS
        finally:
            self.count_faults()
            rt_leave(&self.task, RT_COMMAND)

    cdef int once(self, cycle, LocalTable local, stable, Ring ring, int leave) except -1:
        """Run one cycle; the module's exception comes through, the cycle then failed."""
        cdef rt_cost *cost = &self.cost
        cdef int flags = 0
        memset(cost, 0, sizeof(rt_cost))
        rt_begin(&self.task)
        cost.start_ns = rt_now()
        if local is not None:
            flags = local.c_copy_in()
            cost.stable = stable is not None and local.c_illegal()
        cost.torn = flags & COPY_TORN
        cost.stale = (flags & COPY_STALE) != 0
        self.flags = flags
        cost.failed = (flags & leave) != 0
        cost.called_ns = rt_now()
        try:
            if not cost.failed:
                self.call(stable if cost.stable else cycle)
        except:
            cost.failed = 1
            raise
        finally:
            cost.returned_ns = rt_now()
            if not cost.failed and local is not None:
                self.flags |= local.c_commit(cost.returned_ns,
                                             rt_cycles(self.task.slot) + 1)
                cost.failed = (self.flags & ~COPY_FLAGS) != 0
            self.close(local, ring)
        return 0

    cdef int call(self, method) except -1:
        cdef int64_t dt = rt_step(&self.task)
        if dt != self.dt_ns:
            self.dt_ns = dt
            self.dt = dt * 1e-9
        method(self.dt)
        return 0

    cdef void close(self, LocalTable local, Ring ring) noexcept:
        """Record and account; then the cycle is over."""
        cdef rt_cost *cost = &self.cost
        cdef uint64_t cpu
        cost.end_ns = rt_now()
        cpu = rt_thread_cpu()
        cost.cpu_ns = cpu - self.cpu_mark
        self.cpu_mark = cpu
        if ring is not None and not cost.failed:
            cost.lost = not self.record(local, ring)
        rt_account(&self.task, cost)
        if not rt_cycles(self.task.slot) & 63:
            self.count_faults()
        rt_end(&self.task)

    cdef bint record(self, LocalTable local, Ring ring) noexcept:
        cdef ring_record r
        cdef rt_cost *cost = &self.cost
        r.cycle = rt_cycles(self.task.slot) + 1
        r.release_ns = self.task.rel_ns
        r.start_ns = cost.called_ns
        r.end_ns = cost.end_ns
        r.cpu_ns = cost.cpu_ns
        r.flags = <uint32_t>self.flags | (RING_STABLE if cost.stable else 0)
        r.n_consumed = 0
        r.bytes = 0
        if local is None:
            return ring_put(ring.r, &r, NULL, NULL)
        r.n_consumed = local.n_consumed
        r.bytes = local.out_bytes
        return ring_put(ring.r, &r, <const uint64_t *>local.consumed, local.out_data)

    cdef void count_faults(self) noexcept:
        cdef uint64_t now = rt_faults()
        rt_count_faults(self.task.slot, now - self.fault_mark)
        self.fault_mark = now

    cdef rt_slot *live(self) except NULL:
        self.table.open()
        return self.task.slot

    def __dealloc__(self):
        rt_unguard_slot(self.task.slot)

    def disarm(self) -> None:
        self.live()
        rt_leave(&self.task, RT_OFF)

    def command_level(self) -> None:
        self.live()
        cdef int error = rt_command_level(&self.task)
        if error:
            raise RealTimeError("the level of commands is refused",
                                expected=f"SCHED_FIFO {RT_COMMAND_LEVEL}",
                                got=os.strerror(error))

    @property
    def armed(self) -> bool:
        return rt_mode_of(self.live()) != RT_OFF

    @property
    def stable(self) -> bool:
        return bool(self.cost.stable)

    @property
    def release_ns(self) -> int:
        return self.task.rel_ns

    @property
    def cycles(self) -> int:
        return rt_cycles(self.live())

    @property
    def missed(self) -> int:
        return rt_missed(self.live())

    @property
    def period_ns(self) -> int:
        return rt_period(self.live())

    @property
    def pending(self) -> bool:
        return bool(rt_pending(self.live()))


include "_rt_process.pxi"
