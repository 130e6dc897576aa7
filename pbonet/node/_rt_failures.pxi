# Part of _rt.pyx: timing failures as Python sees them; failure.h has the argument.

import signal as _signals

FAIL_SIGNAL = RT_FAIL_SIGNAL
KINDS = ("deadline", "maxexec", "minexec")
CONTINUE, ABORT, SKIP = range(3)
HANDLER_BOUND_NS = 500_000_000


class Aborted(BaseException):
    """Leaves a cycle for the mark in `Slot.run`; no module should catch it."""


cdef class Critical:
    """Holds timing failures off; one object for all sections of a task."""

    cdef Failures failures

    def __enter__(self):
        rt_lock()

    def __exit__(self, *_):
        if rt_unlock():
            self.failures.deliver()


cdef class Timed:
    """Times one section of the cycle in CPU time."""

    cdef rt_slot *slot
    cdef int index
    cdef uint64_t begun

    def __enter__(self):
        self.begun = rt_thread_cpu()

    def __exit__(self, *_):
        rt_time_section(self.slot, self.index, rt_thread_cpu() - self.begun)


cdef class Failures:
    """Delivers the failures of one task to its handler, in its main thread."""

    cdef rt_task *task
    cdef CoreTable table        # keeps the memory
    cdef object handler
    cdef public object error
    cdef bint skip
    cdef Critical section
    cdef dict timers

    cdef int guard(self, rt_task *task, CoreTable table) except -1:
        self.task = task
        self.table = table
        self.timers = {}
        self.section = Critical()
        self.section.failures = self
        _signals.signal(RT_FAIL_SIGNAL, self.deliver)
        cdef int error = rt_guard_failures(task, HANDLER_BOUND_NS,
                                           PyErr_SetInterruptEx)
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
        if not rt_is_outside():
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
                remedy="let it decide only; work belongs into cycle()")
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

    def critical(self):
        return self.section

    def timed(self, str name):
        found = self.timers.get(name)
        return self.timer(name) if found is None else found

    cdef Timed timer(self, str name):
        cdef bytes text = name.encode()
        if not text or len(text) >= RT_SECTION_NAME:
            raise ValueError(f"a timed section's name has 1 to {RT_SECTION_NAME - 1} "
                             f"bytes, not {len(text)}: {name!r}")
        cdef Timed timer = Timed()
        self.table.open()
        timer.slot = self.task.slot
        timer.index = rt_section(self.task.slot, text)
        if timer.index < 0:
            raise ValueError(f"a task has at most {RT_SECTIONS} timed sections; "
                             f"{name!r} is one too many")
        self.timers[name] = timer
        return timer

    @property
    def criticality(self) -> int:
        self.table.open()
        return rt_crit_of(self.task.slot)

    @criticality.setter
    def criticality(self, int crit):
        self.wish(_within("criticality", crit, 0, 63), 0)

    @property
    def deadline(self) -> float:
        self.table.open()
        if self.task.kind != RT_PERIODIC:
            return 0.0
        return (rt_deadline_of(self.task.slot) - self.task.rel_ns) * 1e-9

    @deadline.setter
    def deadline(self, double seconds):
        cdef int64_t ns = <int64_t>(_within("deadline", seconds, 1e-6, 1e6) * 1e9)
        self.wish(-1, self.task.rel_ns + ns)

    cdef int wish(self, int crit, int64_t deadline) except -1:
        self.table.open()
        if not rt_handles():
            raise TaskError("only timing_failure() changes criticality and deadline",
                            remedy="return from cycle() earlier, or write a handler")
        rt_wish(self.task, crit, deadline)
        return 0

    def __dealloc__(self):
        if self.task is not NULL:
            rt_unguard_failures(self.task)
