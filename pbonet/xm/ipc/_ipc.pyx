# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = _queue.pxi steady.h object.h line.h sem.h queue.h mail.h ../svar/lock.h ../svar/arena.h ../svar/register.h
"""Thin wrapper of the C headers in this folder; documented in `_ipc.pyi`."""

import contextlib
import os
from enum import IntEnum

from cpython.buffer cimport (PyBUF_SIMPLE, PyBUF_WRITABLE, PyBuffer_Release,
                             PyObject_GetBuffer)
from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t, int64_t, uint8_t, uint32_t, uint64_t
from libc.string cimport memset
from posix.mman cimport (MAP_FAILED, MAP_POPULATE, MAP_SHARED, PROT_READ, PROT_WRITE,
                         madvise, mmap, munmap)
from posix.unistd cimport close

from pbonet import shm
from pbonet.errors import (XmDamagedError, XmDestroyedError, XmError, XmFullError,
                           XmLayoutError, XmQueueFullError, XmTooLongError)
from pbonet.outside import active
from pbonet.xm.ipc import names
from pbonet.xm.ipc import shm_object_files as files
from pbonet.xm.ipc._headers cimport *

PATROL_NS = XM_PATROL_NS
LONGEST = 0xfffffffe
MOST = 1 << 20
cdef long _forks = 0       # after a fork the child becomes a member of its own

cdef void *c_steady() noexcept nogil:
    return xm_steady_here()


class Taken(IntEnum):
    TIMED_OUT = 0
    TAKEN = 1
    HOLDER_DIED = 2


class Policy(IntEnum):
    FIFO = 0
    LIFO = 1
    HPF = 2


class Full(IntEnum):
    REFUSE = 0
    DROP = 1
    DROP_OLDEST = 2


cdef object _TAKEN = Taken.TAKEN, _DIED = Taken.HOLDER_DIED, _TIMED_OUT = Taken.TIMED_OUT


def _heard(make, name, **settings):
    """Return the object for a module whose inputs are recorded or replayed."""
    from pbonet.xm.ipc import recorded_ipc as heard
    return heard.opened(make, name, settings)


def _forked():
    global _forks
    _forks += 1


os.register_at_fork(after_in_child=_forked)


cdef class Shared:
    """Common part of semaphores and queues: the file, the member, the waiting."""

    cdef void *at
    cdef size_t bytes
    cdef int fd
    cdef int waits              # threads that use it without the GIL
    cdef uint32_t me
    cdef long forks             # value of `_forks` when `me` became a member; -1: never
    cdef readonly str name, path

    def __cinit__(self):
        self.fd = self.forks = -1

    cdef map(self, str path, int fd, size_t size):
        self.path, self.fd, self.bytes = path, fd, size
        cdef void *at = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE,
                             fd, 0)
        if at == MAP_FAILED:
            raise MemoryError("the file cannot be mapped")
        self.at = at
        madvise(at, size, 23)   # MADV_POPULATE_WRITE, Linux 5.14: no page faults in a cycle

    cdef judge(self, int verdict):
        if verdict == XM_BAD_VERSION:
            raise XmLayoutError("it was made by another version of pbonet", where=self.path,
                                expected=f"version {XM_VERSION} and this C library",
                                got=f"version {(<xm_object *>self.at).version}",
                                remedy="run the same version in every process")
        if verdict:
            raise XmDamagedError("the file is damaged, or of another kind",
                                 where=self.path, got=f"{self.bytes} bytes",
                                 remedy="stop the processes that use it, and remove it")

    cdef int enter(self) except -1:
        raise NotImplementedError  # abstract: each kind of object has its own

    cdef int leave(self) except -1:
        raise NotImplementedError  # abstract: each kind of object has its own

    cdef xm_object *open(self) except NULL:
        """Return the object, ready for use."""
        if self.at is NULL:
            raise XmError("it is closed", where=self.name)
        if xm_destroyed(<xm_object *>self.at):
            raise XmDestroyedError("it was destroyed", where=self.name,
                                   remedy="create it again, or attach to the new one")
        if self.forks != _forks:
            self.enter()
        return <xm_object *>self.at

    cdef int joined(self, int code) except -1:
        """Store this process's member index."""
        if code < 0:
            self.fail(code)
        self.me, self.forks = code, _forks
        return 0

    cdef int fail(self, int code) except -1:
        if code == XM_STUCK:
            raise XmError("its lock was not free for 2 s", where=self.name,
                          remedy="check for a stopped process (state T) that uses it")
        if code == XM_CROWDED:
            raise XmFullError("too many processes use it, or threads wait for it", where=self.name,
                              expected=f"at most {XM_MEMBERS} processes and {XM_SLOTS} "
                              "waiting threads")
        raise XmDamagedError("it was overwritten", where=self.path,
                             remedy="stop the processes that use it, and remove it")

    cdef void look_around(self) noexcept nogil:
        pass

    cdef int sleep(self, int slot, int64_t until, object still) except -1:
        """Wait until called (1) or until the time-out (0); signals are handled."""
        cdef xm_object *o = <xm_object *>self.at
        cdef int code
        while True:
            with nogil:
                code = xm_sleep(&o.slots[slot], until)
                if code == XM_AGAIN or code == XM_TIMED_OUT:
                    self.look_around()
                    if code == XM_TIMED_OUT:    # the patrol may have called it
                        code = xm_sleep(&o.slots[slot], until)
            if xm_destroyed(o):
                self.open()
            if code == 0 or code == XM_TIMED_OUT:
                return code == 0
            PyErr_CheckSignals()
            if still is not None and not still():
                raise XmError("the wait was cancelled", where=self.name,
                              remedy="wait again")

    @property
    def waiting(self) -> int:
        return xm_waiting(self.open())

    def close(self) -> None:
        if self.at is NULL:
            return
        if self.waits:
            raise XmError("a thread waits for it", where=self.name,
                          remedy="let it end first, or destroy it")
        if self.forks == _forks and not xm_destroyed(<xm_object *>self.at):
            self.leave()
        self.unmap()

    cdef void unmap(self) noexcept:
        if self.at is not NULL:
            munmap(self.at, self.bytes)
            self.at = NULL
        if self.fd >= 0:
            close(self.fd)
            self.fd = -1

    def destroy(self) -> None:
        if self.at is NULL:
            return
        from pathlib import Path
        shm.remove_same(Path(self.path), self.fd)
        xm_destroy(<xm_object *>self.at)
        if not self.waits:
            self.unmap()

    def __dealloc__(self):
        self.drop()

    cdef drop(self):
        if self.at is not NULL:
            with contextlib.suppress(Exception):
                Shared.close(self)
        self.unmap()


cdef inline int64_t _limit(object until_ns) except? -1:
    """Return a time-out as C expects it; times up to 0 are in the past."""
    if until_ns is None:
        return XM_FOREVER
    cdef int64_t until = until_ns
    return until if until > 0 else 1


cdef inline int32_t _priority(object priority) except? -1:
    return names.home().priority() if priority is None else priority


cdef class Semaphore(Shared):
    cdef xm_sem *s

    @staticmethod
    def create(name, *, initial=1, maximum=None, binary=False):
        highest = 1 if binary else 0x7fffffff if maximum is None else maximum
        if binary and maximum not in (None, 1):
            raise ValueError(f"the maximum of a binary semaphore is 1, not {maximum}")
        if not 1 <= highest <= 0x7fffffff or not 0 <= initial <= highest:
            raise ValueError(f"initial {initial} and maximum {highest} are not "
                             "0 <= initial <= maximum < 2**31")
        if active():
            return _heard(Semaphore.create, name, initial=initial, maximum=maximum,
                          binary=binary)
        found, here = names.find(name)
        if not here:
            from pbonet.xm.ipc import remote_resources
            return remote_resources.RemoteSemaphore.create_there(found, initial, highest, binary)
        path = found.path("sem")
        fd, fresh = files.FILES.make(path, sizeof(xm_sem))
        cdef Semaphore self = Semaphore.__new__(Semaphore)
        self.name = str(found)
        try:
            self.map(str(path), fd, sizeof(xm_sem))
            self.s = <xm_sem *>self.at
            self.judge(xm_sem_make(self.s, initial, highest, binary))
            self.enter()
        except BaseException:
            fresh.unlink()
            raise
        files.FILES.publish(fresh, path)
        return self

    @staticmethod
    def attach(name):
        if active():
            return _heard(Semaphore.attach, name)
        found, here = names.find(name)
        if not here:
            from pbonet.xm.ipc import remote_resources
            return remote_resources.RemoteSemaphore.attach_there(found)
        fd, size = files.open_file(found, "sem")
        cdef Semaphore self = Semaphore.__new__(Semaphore)
        self.name = str(found)
        self.map(str(found.path("sem")), fd, max(1, size))
        self.judge(XM_DAMAGED if size == 0
                   else xm_sem_verify(<xm_sem *>self.at, self.bytes))
        self.s = <xm_sem *>self.at
        self.enter()
        return self

    cdef int enter(self) except -1:
        return self.joined(xm_sem_enter(self.s))

    cdef int leave(self) except -1:
        cdef int code = xm_sem_exit(self.s, self.me)
        return self.fail(code) if code else 0

    cdef void look_around(self) noexcept nogil:
        xm_sem_patrol(self.s, self.me)

    @property
    def value(self) -> int:
        self.open()
        return xm_sem_value(self.s)

    @property
    def maximum(self) -> int:
        self.open()
        return self.s.maximum

    @property
    def binary(self) -> bool:
        self.open()
        return bool(self.s.binary)

    @property
    def holder(self):
        self.open()
        return xm_sem_holder_pid(self.s) or None

    def p(self, until_ns=None, *, priority=None, still=None):
        self.open()
        cdef int code = xm_sem_take(self.s, self.me, False)
        if code == XM_EMPTY:
            code = self.wait(_limit(until_ns), _priority(priority), still)
        return _TAKEN if code == 0 else _DIED if code == XM_DIED else _TIMED_OUT

    def try_p(self):
        self.open()
        cdef int slot, code = xm_sem_begin(self.s, self.me, 0, False, &slot)
        if code == XM_STUCK:
            self.fail(code)
        return _TAKEN if code == 0 else _DIED if code == XM_DIED else _TIMED_OUT

    def v(self, *, answer=True) -> bool:
        self.open()
        return xm_sem_give(self.s) == 0

    cdef int wait(self, int64_t until, int32_t priority, object still) except? -100:
        """Take one by waiting in line; 0, XM_DIED or XM_EMPTY."""
        cdef int slot, code = xm_sem_begin(self.s, self.me, priority, True, &slot)
        if code == XM_STUCK or code == XM_CROWDED:
            self.fail(code)
        if code != XM_AGAIN:
            return code
        self.waits += 1
        try:
            while code == XM_AGAIN:
                if not self.sleep(slot, until, still):
                    xm_sem_leave(self.s, slot)
                    return XM_EMPTY
                code = xm_sem_called(self.s, self.me, slot)
            if code == XM_STUCK:
                self.fail(code)
            return code
        except BaseException:
            xm_sem_leave(self.s, slot)
            raise
        finally:
            self.waits -= 1

    def __enter__(self):
        return self.p()

    def __exit__(self, *_):
        self.v()

    def __repr__(self):
        return f"<Semaphore {self.name}>"


include "_queue.pxi"
