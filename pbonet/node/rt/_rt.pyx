# cython: language_level=3, boundscheck=False, wraparound=False, freethreading_compatible=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = ../../outside/tape.h ../../cmodule/pbonet.h ../../cmodule/instance.h ../../cmodule/running.h layout.h state.h watch.h wait.h device.h muf.h standby.h call.h vigil.h dispatch.h sys.h restrict.h table.h look.h looker.h lease/lend.h lease/take.h loop.h slot.h failure.h signals.h interrupts.h view.h ../ring/ring.h guard.h ../../svar/flag.h ../../svar/safe.h ../../xm/ipc/steady.h _rt_process.pxi _rt_failures.pxi _rt_table.pxi _rt_standby.pxi
"""Thin wrapper of the C headers in this folder; documented in `_rt.pyi`."""

import os

from cpython.exc cimport PyErr_CheckSignals
from libc.errno cimport EACCES, ENOSPC, EPERM
from libc.stdint cimport int32_t, int64_t, uint8_t, uint32_t, uint64_t
from libc.stdlib cimport calloc, free, malloc
from libc.string cimport memset, strdup, strncat

from pbonet import shm
from pbonet.errors import NodeError, RealTimeError, TaskError
from pbonet.node.ring import _ring
from pbonet.node.rt import rt_capabilities as rights
from pbonet.cmodule._cmodule cimport NativeMethod, c_running, pbo_run
from pbonet.node.ring._ring cimport (
    RING_HELD, RING_SAFE, RING_STABLE, RING_SYNC, RING_WANT_NEW, Ring, ring_fits, ring_put, ring_record,
    ring_stage, ring_wanted, ring_wants,
)
from pbonet.node.rt._rt_headers cimport *
from pbonet.outside._tape cimport Tape, tape, tape_empty, tape_ready
from pbonet.analysis.schedule import octaves
from pbonet.analysis.schedule import (
    CoreStatus, Decision, Histograms, Kind, Mode, Section, SlotStatus,
)
from pbonet.svar._svar cimport Arena, LocalTable, c_guard_map, c_unguard_map
from pbonet.tbuf._tbuf cimport c_defer_bells, c_ring_bells
from pbonet.xm.ipc._ipc cimport c_steady

COMMAND = RT_WAIT_COMMAND
ORPHAN = RT_WAIT_ORPHAN
FLAGS = 3
ABORTED = 4
LAST = 5
ENGAGED = 6
IDLE = RT_WAIT_IDLE
FALLBACK = RT_FALLBACK
HANDOVER = RT_HANDOVER
SLOTS = RT_SLOTS
MIN_PERIOD_NS = RT_MIN_PERIOD_NS
COMMAND_LEVEL = RT_COMMAND_LEVEL
DISPATCHER_LEVEL = RT_DISPATCHER_LEVEL
LEAVE = 8 | 16 | 32 | 64 | 128
globals().update(Ring=_ring.Ring, Record=_ring.Record, parse=_ring.parse)  # a cimported name is C's alone
_BACKENDS = {RT_NONE: "", RT_FIFO: "fifo", RT_PARK: "park"}

cdef enum:
    COPY_TORN = 1
    COPY_STALE = 2
    COPY_FLAGS = 15 | 256

cdef enum:      # what runs: pbonet.svar.Action
    GO_ON, HOLD, STABLE, SAFE, ERROR

cdef enum:      # how far a cycle is
    WAITING, LEFT_OUT, COPIED, DECIDED, RETURNED, ENDED


include "_rt_table.pxi"
include "_rt_failures.pxi"


cdef class Slot:
    cdef rt_task task
    cdef rt_cost cost
    cdef readonly CoreTable table
    cdef readonly int index, flags
    cdef int64_t dt_ns, told_ns     # of the last cycle; of `dt`
    cdef object dt
    cdef uint64_t cpu_mark, fault_mark
    cdef public int64_t stamp_ns
    cdef ring_record record
    cdef public Tape tape
    cdef readonly Failures failures
    cdef bint vowed, is_aged
    cdef bint reports   # the last method in C has reported something
    cdef readonly bint safe     # the last cycle has failed, and its out-vars are safe
    cdef readonly int action    # what ran last in place of `cycle`; 0: that itself
    cdef int critical           # what runs while the flag is up; 0: `cycle`
    cdef object aged, stable_method, safe_method
    cdef NativeMethod native, native_stable     # methods in C, called by pointer
    cdef bint alone     # `cycle` is in C, and needs the interpreter for what is rare only

    def __init__(self, CoreTable table not None, int i):
        self.task.table = table.open()
        self.task.slot = table.slot(i)
        self.table = table
        self.index = i
        self.dt_ns = self.told_ns = -1
        self.failures = Failures()
        self.failures.of(&self.task, table)
        if not rt_is_virtual(self.task.table):
            rt_guard_slot(&self.task, <xm_steady *>c_steady())
            self.failures.guard()

    def run(self, cycle, LocalTable local, *, stable=None, safe=None, int critical=0,
            sync=None, Ring ring=None, int leave=LEAVE, failing=None, aged=None) -> int:
        cdef int why, served = 0, last = 0, at
        cdef bint periodic = rt_kind_of(self.live()) == RT_PERIODIC
        if periodic == (sync is not None):
            raise ValueError("`sync` is required for tasks that are not periodic, and only for them")
        self.failures.handler = failing
        self.aged, self.critical = aged, critical
        self.stable_method, self.safe_method = stable, safe
        self.native = self.in_c(cycle)
        self.native_stable = self.in_c(stable)
        self.alone = self.native is not None and periodic
        if rt_mode_of(self.task.slot) == RT_OFF:
            self.is_aged = False
        self.failures.error = None
        self.safe = False
        if local is not None:
            local.c_share(&self.task.slot.safe)
            rt_use_safe(<void (*)(void *) noexcept nogil>local.make_safe, local.core)
        rt_arm(&self.task)
        self.cpu_mark = rt_mark_cpu(&self.task)
        self.fault_mark = rt_faults()
        try:
            while True:
                at = WAITING
                with nogil:
                    why = rt_wait(&self.task, served)
                    while self.alone and why == RT_RELEASED:
                        served = 1
                        at = self.once_alone(local, ring, leave)
                        if at != ENDED or self.flags & leave or self.cost.aborted:
                            break
                        last = rt_was_last(&self.task)
                        if last:
                            break
                        if rt_take_interrupt():
                            why = RT_WAIT_SIGNAL
                        else:
                            why = rt_wait(&self.task, served)
                if why == RT_WAIT_SIGNAL:
                    PyErr_CheckSignals()
                elif why != RT_RELEASED:
                    return why
                else:
                    served = 1
                    if not periodic and not self.wait_outside(sync, ring):
                        continue
                    if at != ENDED:
                        self.once(at, cycle, local, ring, leave)
                    if self.cost.aborted:
                        return ABORTED
                    if self.flags & leave or self.action == ERROR:
                        return FLAGS
                    last = last or rt_was_last(&self.task)
                    if last:
                        return LAST
        finally:
            if local is not None and local.c_end_cycle():   # `aged` has raised
                self.safe = True
            rt_use_safe(NULL, NULL)
            self.count_faults()
            if not last and why != RT_WAIT_IDLE:
                rt_leave(&self.task, RT_COMMAND)

    cdef NativeMethod in_c(self, method):
        """Return a method if it is in C, made ready for the cycles of this run."""
        cdef NativeMethod native
        if type(method) is not NativeMethod:
            return None
        native = method
        native.begin(rt_cycles(self.task.slot))
        return native

    cdef bint wait_outside(self, sync, Ring ring) except -1:
        """Wait as the module's `sync` does; return whether its event came."""
        cdef bint called = False
        try:
            if rt_enter(RT_IN_SYNC):
                self.failures.handle()
            called = True
            sync()
        except Aborted:
            rt_exit()
            if called:
                self.put_sync(ring)
            self.raise_error()
            return False
        finally:
            rt_exit()
        self.put_sync(ring)
        return True

    cdef int put_sync(self, Ring ring) except -1:
        """Record what the module read from outside during a wait, for the replay.

        A wait without new input is recorded, too: its requests count as calls.
        """
        cdef ring_record *r = &self.record
        if ring is None or self.tape is None:
            return 0
        tape_ready(&self.tape.t)
        memset(r, 0, sizeof(ring_record))
        r.kind = RING_SYNC
        r.cycle = rt_cycles(self.task.slot)
        r.release_ns = self.task.rel_ns     # the time that the module was given
        r.start_ns = r.end_ns = rt_time(self.task.table)
        r.bytes = self.tape.t.used
        ring_put(ring.r, r, NULL, self.tape.t.bytes, NULL)
        tape_empty(&self.tape.t)
        return 0

    cdef int raise_error(self) except -1:
        """Raise the exception of the module's failure handler, if any."""
        error = self.failures.error
        if error is not None:
            raise error
        return 0

    cdef int leave_out(self) except -1:
        """Skip a release; the failure handler is called for it."""
        cdef uint64_t cpu
        self.failures.skip = False
        self.flags = 0
        try:
            self.failures.handle()
        except Aborted:
            rt_exit()
            self.raise_error()
        finally:
            cpu = rt_mark_cpu(&self.task)
            rt_skipped(&self.task, cpu - self.cpu_mark)
            self.cpu_mark = cpu
            rt_end(&self.task)
        return 0

    cdef void choose(self, LocalTable local) noexcept nogil:
        """Choose what runs in place of `cycle` now; 0: that itself."""
        if local is None:
            return
        if local.c_aged():
            self.action = local.c_action()
            if not self.action:
                self.action = self.critical
        elif self.critical and local.c_illegal():
            self.action = self.critical

    cdef bint begin(self, LocalTable local) noexcept nogil:
        """Begin a cycle and copy its inputs in; returns whether it is left out."""
        self.action = GO_ON
        memset(&self.cost, 0, sizeof(rt_cost))
        if not rt_begin(&self.task) or self.failures.skip:
            return True
        c_defer_bells()
        if local is not None:
            local.c_begin_cycle(rt_number_of(&self.task))
        self.cost.start_ns = rt_time(self.task.table)
        self.flags = 0 if local is None else local.c_copy_in()
        return False

    cdef bint must_tell_age(self, LocalTable local) noexcept nogil:
        """Return whether inputs have become stale or fresh."""
        return local is not None and local.c_to_report() != self.is_aged

    cdef void decide(self, LocalTable local, Ring ring, int leave) noexcept nogil:
        """Decide what runs in the cycle, and begin its record."""
        cdef rt_cost *cost = &self.cost
        self.choose(local)
        cost.stable = self.action != GO_ON
        cost.torn = self.flags & COPY_TORN
        cost.stale = (self.flags & COPY_STALE) != 0
        cost.failed = (self.flags & leave) != 0 or self.action == ERROR
        if ring is not None:
            self.begin_record(local, ring)
        cost.called_ns = rt_time(self.task.table)

    cdef int once_alone(self, LocalTable local, Ring ring, int leave) noexcept nogil:
        """Run a cycle in C up to what needs the interpreter, mostly to its end."""
        if self.begin(local):
            return LEFT_OUT
        if self.must_tell_age(local):
            return COPIED
        self.decide(local, ring, leave)
        if self.cost.failed or self.action != GO_ON or rt_enter(RT_IN_CYCLE):
            return DECIDED
        if self.run_c(self.native):
            return RETURNED
        rt_exit()
        self.finish(local, ring)
        return ENDED

    cdef int once(self, int at, cycle, LocalTable local, Ring ring, int leave) except -1:
        """Run one cycle, or what is left of it after `at`.

        An exception of the module propagates and marks it failed.
        """
        cdef rt_cost *cost = &self.cost
        if at == LEFT_OUT or at == WAITING and self.begin(local):
            return self.leave_out()
        if at < DECIDED:
            if self.must_tell_age(local):
                self.tell_age(not self.is_aged)
            self.decide(local, ring, leave)
        try:
            if at == RETURNED:
                self.report(self.native)
                rt_exit()
            elif not cost.failed:
                if rt_enter(RT_IN_CYCLE):
                    self.failures.handle()
                if self.action == GO_ON:
                    if self.native is not None:
                        self.call_c(self.native)
                    else:
                        self.call(cycle)
                elif self.action != HOLD:
                    if self.action == STABLE and self.native_stable is not None:
                        self.call_c(self.native_stable)
                    else:
                        self.call(self.stable_method if self.action == STABLE
                                  else self.safe_method)
                rt_exit()
        except Aborted:
            rt_exit()
            cost.failed = cost.aborted = 1
            self.raise_error()
        except:
            rt_exit()
            cost.failed = 1
            raise
        finally:
            self.finish(local, ring)
        return 0

    cdef void finish(self, LocalTable local, Ring ring) noexcept nogil:
        """Copy the outputs out, and end the cycle."""
        cdef rt_cost *cost = &self.cost
        cost.returned_ns = rt_time(self.task.table)
        if not cost.failed and local is not None and self.action != HOLD:
            if self.action != GO_ON:
                local.c_make_new()  # what stands in for `cycle` does not use old inputs
            self.flags |= local.c_commit(
                0 if self.action != GO_ON else self.stamp_ns, cost.returned_ns,
                rt_cycles(self.task.slot) + 1)
            cost.failed = (self.flags & ~COPY_FLAGS) != 0
        if local is not None and local.c_end_cycle():
            self.safe = True
            cost.failed = cost.aborted = 1
        self.close(local, ring)

    cdef int tell_age(self, bint stale) except -1:
        """Call `aged` because inputs became stale or fresh; rare, so it may be Python."""
        self.is_aged = stale
        if self.aged is not None:
            self.aged(stale)
        return 0

    cdef int call(self, method) except -1:
        cdef int64_t dt = rt_step(&self.task)
        self.dt_ns = dt
        if dt != self.told_ns:
            self.told_ns = dt
            self.dt = dt * 1e-9
        method(self.dt)
        return 0

    cdef int call_c(self, NativeMethod method) except -1:
        """Call a method in C; a timing failure is handled when it has returned."""
        return self.report(method) if self.run_c(method) else 0

    cdef bint run_c(self, NativeMethod method) noexcept nogil:
        """Run a method in C; returns whether `report` is to follow."""
        self.dt_ns = rt_step(&self.task)
        method.one.task.dt = self.dt_ns * 1e-9
        method.one.task.now_ns = self.task.rel_ns
        method.one.task.cyclecount = rt_cycles(self.task.slot) - method.before
        self.reports = pbo_run(method.function, method.one)
        return self.reports or rt_has_failed(&self.task)

    cdef int report(self, NativeMethod method) except -1:
        """Pass on what a method in C has reported, and handle the cycle's failures."""
        self.failures.returned = method.name
        try:
            if self.reports:
                method.of.pass_on(method.name)
            if rt_has_failed(&self.task):
                self.failures.handle()
        finally:
            self.failures.returned = ""
        return 0

    cdef void close(self, LocalTable local, Ring ring) noexcept nogil:
        """Record and account the cycle, and end it."""
        cdef rt_cost *cost = &self.cost
        cdef uint64_t cpu
        cost.end_ns = rt_time(self.task.table)
        cpu = rt_mark_cpu(&self.task)
        cost.cpu_ns = cpu - self.cpu_mark
        self.cpu_mark = cpu
        if ring is not None and not cost.failed:
            cost.lost = not self.end_record(local, ring)
        rt_account(&self.task, cost)
        if not rt_cycles(self.task.slot) & 63:
            self.count_faults()
        rt_end(&self.task)
        c_ring_bells()      # readers on other machines, which this cycle wrote to

    cdef void begin_record(self, LocalTable local, Ring ring) noexcept nogil:
        """Compute the record's size; store the inputs, which `cycle` may change."""
        cdef ring_record *r = &self.record
        cdef size_t n, at = 0
        cdef const void *value
        cdef int i
        r.n_consumed = r.bytes = r.in_bytes = r.heard_bytes = r.kind = 0
        r.uid = r.number = 0
        if local is None:
            return
        r.n_consumed = local.n_consumed
        r.bytes = local.out_bytes
        r.in_bytes = local.c_due(ring_wants(ring.r) != 0)
        if r.in_bytes and not ring_fits(ring.r, r):
            r.in_bytes = 0      # the next cycle stores them
        if not r.in_bytes:
            return
        for i in range(local.c_inputs()):
            value = local.c_input(i, &n)
            ring_stage(ring.r, r, at, value, n)
            at += n

    cdef bint end_record(self, LocalTable local, Ring ring) noexcept nogil:
        cdef ring_record *r = &self.record
        cdef rt_cost *cost = &self.cost
        cdef const void *heard = NULL
        cdef tape *t
        cdef bint kept
        if self.tape is not None and tape_ready(&self.tape.t):
            t = &self.tape.t
            heard, r.heard_bytes = t.bytes, t.used
            if not ring_fits(ring.r, r):    # keep the record, drop the outside inputs
                t.used, t.lost = 0, 1
                r.heard_bytes = tape_ready(t)
            tape_empty(t)
        r.cycle = rt_cycles(self.task.slot) + 1
        r.release_ns = self.task.rel_ns
        r.start_ns = cost.called_ns
        r.end_ns = cost.end_ns
        r.dt_ns = self.dt_ns
        r.cpu_ns = cost.cpu_ns
        r.flags = <uint32_t>self.flags
        if self.action != GO_ON:
            r.flags |= (RING_STABLE if self.action == STABLE else
                        RING_HELD if self.action == HOLD else RING_SAFE)
        if local is None:
            return ring_put(ring.r, r, NULL, NULL, heard)
        r.uid, r.number = local.out_uid, local.out_number
        kept = ring_put(ring.r, r, <const uint64_t *>local.consumed, local.out_data,
                        heard)
        if kept and r.in_bytes:
            local.c_stored()
            if ring_wants(ring.r) & RING_WANT_NEW:
                ring_wanted(ring.r)
        return kept

    cdef void count_faults(self) noexcept nogil:
        cdef uint64_t now = rt_faults()
        rt_count_faults(self.task.slot, now - self.fault_mark)
        self.fault_mark = now

    cdef rt_slot *live(self) except NULL:
        self.table.open()
        return self.task.slot

    def __dealloc__(self):
        if self.vowed:
            rt_release_vow(self.task.slot)
        rt_unguard_failures(&self.task)
        rt_unguard_slot(self.task.slot)

    def stand_by(self) -> int:
        self.live()
        cdef int why
        rt_stand_by_for(&self.task)
        try:
            while True:
                with nogil:
                    why = rt_wait(&self.task, 0)
                if why == RT_RELEASED:
                    return ENGAGED
                if why != RT_WAIT_SIGNAL:
                    return why
                PyErr_CheckSignals()
        finally:
            if why != RT_RELEASED and why != RT_WAIT_IDLE:
                rt_leave(&self.task, RT_OFF)

    def arm(self) -> None:
        self.live()
        self.is_aged = False
        rt_arm(&self.task)

    def disarm(self, calls=()) -> list:
        # Call first: a task killed here is either seen to die while it is ON, or its
        # successors are engaged. The dispatcher of its own core wakes up once.
        self.live()
        cdef CoreTable table
        cdef list heard = []
        for table, slot, life, ticket, caller in calls:
            heard.append(table.count_call(slot, life, ticket, caller))
            if table.t is not self.task.table:
                rt_kick(table.t)
        rt_rest(&self.task)
        return heard

    def fall(self) -> None:
        self.live()
        rt_fall(&self.task)

    def vow(self) -> None:
        cdef int error = rt_vow(self.live())
        if error:
            raise RealTimeError("the task's process cannot be watched",
                                got=os.strerror(error))
        self.vowed = True

    def command_level(self) -> None:
        self.live()
        cdef int error = rt_command_level(&self.task)
        if error:
            raise RealTimeError("the priority for commands is refused",
                                expected=f"SCHED_FIFO {RT_COMMAND_LEVEL}",
                                got=os.strerror(error))

    def meet_dispatcher(self) -> None:
        self.live()
        rt_meet_dispatcher(&self.task)

    def signal(self, uint32_t bits) -> int:
        return rt_send_signal(self.live(), bits)

    @property
    def sigmask(self) -> int:
        return rt_signal_mask(self.live())

    @property
    def armed(self) -> bool:
        return rt_mode_of(self.live()) != RT_OFF

    @property
    def after(self) -> int:
        return rt_after_of(self.live())

    @property
    def stable(self) -> bool:
        return self.action == STABLE

    @property
    def now_ns(self) -> int:
        return rt_time(self.table.open())

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


include "_rt_standby.pxi"
include "_rt_process.pxi"
