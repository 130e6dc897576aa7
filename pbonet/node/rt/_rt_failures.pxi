# Part of _rt.pyx: timing failures as Python sees them; failure.h explains them.

import signal as _signals

FAIL_SIGNAL = RT_FAIL_SIGNAL
KINDS = ("deadline", "maxexec", "minexec")
CONTINUE, ABORT, SKIP = range(3)
HANDLER_BOUND_NS = 500_000_000


from pbonet.pbo import CycleAborted as Aborted


cdef class Critical:
    """Defers timing failures; one object for all sections of a task."""

    cdef Failures failures

    def __enter__(self):
        rt_lock()

    def __exit__(self, *_):
        if rt_unlock():
            self.failures.deliver()


cdef class Timed:
    """Measures one section of the cycle in CPU time."""

    cdef rt_slot *slot
    cdef CoreTable table        # keeps the memory
    cdef int index, depth
    cdef uint64_t begun

    def __enter__(self):
        self.depth += 1
        if self.depth == 1:
            self.begun = rt_thread_cpu()

    def __exit__(self, *_):
        self.depth -= 1
        if self.depth == 0:
            rt_time_section(self.slot, self.index, rt_thread_cpu() - self.begun)


cdef class Failures:
    """Delivers the failures of one task to its handler, in its main thread."""

    cdef rt_task *task
    cdef CoreTable table        # keeps the memory
    cdef object handler
    cdef public object error
    cdef readonly str returned      # the method in C that has just returned, else ""
    cdef bint skip
    cdef readonly Critical section

    cdef int of(self, rt_task *task, CoreTable table) except -1:
        self.task = task
        self.table = table
        self.section = Critical()
        self.section.failures = self
        self.returned = ""
        return 0

    cdef int guard(self) except -1:
        _signals.signal(RT_FAIL_SIGNAL, self.deliver)
        cdef int error = rt_guard_failures(self.task, HANDLER_BOUND_NS,
                                           PyErr_SetInterruptEx, c_running())
        if error:
            raise RealTimeError("timing failures cannot be delivered",
                                got=os.strerror(error))
        return 0

    def deliver(self, *_):
        """Called by the interpreter between two instructions of the main thread."""
        if rt_handles():
            if rt_is_overdue():
                raise Aborted
            return
        if rt_is_aborting():
            raise Aborted
        if not rt_is_outside() and not self.returned:   # else the loop handles it
            self.handle()

    cdef int handle(self) except -1:
        cdef unsigned kinds
        cdef int kind
        while True:
            kinds = rt_take_failures(self.task)
            if not kinds or self.handler is None:
                return 0
            for kind in range(RT_FAILURES):
                if kinds >> kind & 1:
                    self.one(kind)

    cdef int one(self, int kind) except -1:
        cdef uint32_t told = rt_begin_handler(self.task)
        answer = ABORT
        try:
            answer = self.handler(KINDS[kind])
        except Aborted:
            self.error = TaskError(
                "timing_failure() did not return", got=f"a failure of kind {KINDS[kind]}",
                expected=f"an answer within {HANDLER_BOUND_NS / 1e9:g} s",
                remedy="let it only decide; work belongs in cycle()")
        except BaseException as error:
            self.error = error
        finally:
            rt_end_handler(self.task, told)
        if answer == ABORT:
            rt_begin_abort()
            raise Aborted
        if answer == SKIP:
            self.skip = True
        return 0

    def timed(self, str name):
        cdef Timed timer = Timed()
        self.table.open()
        timer.slot = self.task.slot
        timer.index = rt_section(self.task.slot, name.encode(errors="replace"))
        if timer.index < 0:
            raise ValueError(f"a task has at most {RT_SECTIONS} timed sections")
        timer.table = self.table
        return timer

    @property
    def own_criticality(self) -> int:
        self.table.open()
        return rt_own_crit_of(self.task.slot)

    @property
    def criticality(self) -> int:
        self.table.open()
        return rt_crit_of(self.task.slot)

    @criticality.setter
    def criticality(self, int crit):
        self.table.open()
        rt_wish(self.task, _within("criticality", crit, 0, 63), 0)

    @property
    def deadline(self) -> float:
        self.table.open()
        if self.task.kind == RT_SYNCHRONOUS:
            return (self.task.dl_ns - self.task.rel_ns) * 1e-9
        if self.task.kind != RT_PERIODIC:
            return 0.0
        return (rt_deadline_of(self.task.slot) - self.task.rel_ns) * 1e-9

    @deadline.setter
    def deadline(self, double seconds):
        self.table.open()
        rt_wish(self.task, -1, self.task.rel_ns + <int64_t>(min(seconds, 1e6) * 1e9))

    def __dealloc__(self):
        if self.task is not NULL:
            rt_unguard_failures(self.task)
