# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = triple.h doze.h message.h ../outside/tape.h
"""Thin wrapper of the C headers in this folder; documented in `_tbuf.pyi`."""

import os

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int64_t, uint8_t, uint64_t, uintptr_t
from libc.string cimport memcpy, strncpy
from posix.mman cimport MAP_FAILED, MAP_POPULATE, MAP_SHARED, PROT_READ, PROT_WRITE
from posix.mman cimport madvise, mmap, munmap
from posix.unistd cimport close

from pbonet.errors import (
    ProtocolError, XmDamagedError, XmDestroyedError, XmError, XmLayoutError,
)
from pbonet.outside._tape cimport TAPE_RAW, Outside
from pbonet.tbuf._headers cimport *

WRITER, READER, CARER = TB_WRITER, TB_READER, TB_CARER
LONGEST_TEXT = TB_TEXT
cdef int64_t LOOK_NS = 50_000_000, FOREVER = 0x7fffffffffffffff
cdef tb_bells later         # of this process; only tasks use it, in their one thread


cdef void c_defer_bells() noexcept nogil:
    later.defer = 1


cdef void c_ring_bells() noexcept nogil:
    tb_ring_all(&later)


cdef _refuse_message(int code, tb_head *head, Py_ssize_t got):
    same = "run the same pbonet version on every machine"
    if code == TB_OTHER_MESSAGE:
        raise ProtocolError("the record is of another version",
                            expected=f"version {TB_MESSAGE_VERSION}",
                            got=f"version {head.version}", remedy=same)
    if code == TB_NO_TIME:
        raise ProtocolError("the record's time is impossible", got=f"age {head.age_ns} ns",
                            remedy=same)
    raise ProtocolError("this is not a record of a link", got=f"{got} bytes", remedy=same)


def parts(bytes message) -> tuple:
    cdef tb_head head
    cdef int code = tb_unpack(<const uint8_t *>PyBytes_AS_STRING(message), len(message),
                              &head)
    if code:
        _refuse_message(code, &head, len(message))
    end = sizeof(tb_head) + head.text_bytes
    return (head.number, head.source, head.stamp_ns, head.age_ns,
            message[sizeof(tb_head):end], message[end:])


def _now() -> int:
    return tb_now()


def size_for(uint64_t bytes) -> int:
    return tb_size(bytes)


cdef class Buffer:
    """A buffer's file, mapped whole; its descriptor is ours."""

    cdef tb_buffer *b
    cdef size_t bytes
    cdef tb_form form           # our own, as the file may be overwritten
    cdef readonly bytes text
    cdef readonly int fileno
    cdef readonly str path

    def __cinit__(self, *_, **__):
        self.fileno = -1

    def map(self, int fd, size_t size, str path) -> None:
        self.fileno, self.path, self.bytes = fd, path, max(1, size)
        cdef void *at = mmap(NULL, self.bytes, PROT_READ | PROT_WRITE,
                             MAP_SHARED | MAP_POPULATE, fd, 0)
        if at == MAP_FAILED:
            raise MemoryError("the file cannot be mapped")
        self.b = <tb_buffer *>at
        madvise(at, self.bytes, 23)     # MADV_POPULATE_WRITE: no page faults in a cycle

    def __dealloc__(self):
        self.drop()

    def unmap(self) -> None:
        self.drop()

    cdef drop(self):            # at the end of a process methods may be gone
        if self.b is not NULL:
            munmap(self.b, self.bytes)
            self.b = NULL
        if self.fileno >= 0:
            close(self.fileno)
            self.fileno = -1

    cdef tb_buffer *open(self) except NULL:
        if self.b is NULL:
            raise XmError("it is closed", where=self.path)
        return self.b

    def make(self, uint64_t record, uint64_t source, bytes text) -> None:
        if tb_size(record) > self.bytes or len(text) > TB_TEXT:
            raise ValueError("the file is too small for it")
        tb_make(self.open(), record, source, text, len(text))
        self.keep_form(text, record)

    cdef void keep_form(self, bytes text, uint64_t record):
        self.text = text        # keeps the memory in place
        self.form = tb_form(text=PyBytes_AS_STRING(text), text_bytes=len(text), bytes=record)

    def verify(self) -> None:
        cdef int verdict = tb_verify(self.open(), self.bytes)
        if not verdict:
            self.keep_form((<char *>self.b.text)[:min(self.b.text_bytes, <unsigned>TB_TEXT)],
                     self.b.bytes)
            if tb_size(self.form.bytes) != self.bytes:  # it has changed since
                verdict = TB_DAMAGED
        if verdict == TB_BAD_VERSION:
            raise XmLayoutError("the buffer was made by another version of pbonet",
                                where=self.path, expected=f"version {TB_VERSION}",
                                got=f"version {self.b.version}",
                                remedy="run the same version in every process")
        if verdict == TB_SWAPPED:
            raise XmLayoutError("the buffer is in another byte order", where=self.path,
                                remedy="processors of different byte order are linked "
                                "through agents, not through one memory")
        if verdict:
            raise XmDamagedError("the file is damaged, or is not a buffer", where=self.path,
                                 got=f"{self.bytes} bytes",
                                 remedy="stop the processes that use it, and remove it")

    @property
    def record(self) -> int:
        self.open()
        return self.form.bytes

    @property
    def written(self) -> int:
        return tb_number(self.open().word)

    @property
    def last_ns(self) -> int:
        return self.open().last_ns

    @property
    def destroyed(self) -> bool:
        return bool(self.open().destroyed)

    def mark_destroyed(self) -> None:
        self.open().destroyed = 1
        tb_wake(&self.b.bell)

    def enter(self, int role, str who) -> None:
        cdef bytes text = who.encode()[:TB_WHO - 1]
        strncpy(self.open().roles[role].who, text, TB_WHO - 1)
        self.b.roles[role].pid = os.getpid()

    def who(self, int role) -> str:
        cdef const char *who = self.open().roles[role].who
        return who[:strnlen(who, TB_WHO)].decode(errors="replace")


cdef class End(Buffer):
    """One end of a link: the process's own copy of a record."""

    cdef object raw, own        # as stored in the buffer, and in this process's byte order
    cdef void *copy
    cdef bint converts
    cdef readonly object value  # `own`, as the user sees it
    cdef readonly Outside outside
    cdef tb_stamp stamp

    def hold(self, raw, own, value, Outside outside=None) -> None:
        self.outside = outside
        if not self.played() and raw.nbytes != self.record or not raw.flags.c_contiguous:
            raise ValueError("this array does not fit the link's records")
        self.raw, self.own, self.value, self.converts = raw, own, value, raw is not own
        self.copy = <void *><uintptr_t>raw.ctypes.data
        if outside is not None and outside.recording():
            outside.tape.reserve(raw.nbytes + sizeof(tb_stamp))

    cdef bint played(self):
        return self.outside is not None and self.outside.player is not None

    cdef tb_buffer *ready(self) except NULL:
        if self.b is NULL or self.copy is NULL:
            raise XmError("the link is closed", where=self.path)
        if self.b.destroyed:
            raise XmDestroyedError("the link was destroyed", where=self.path,
                                   remedy="open it again")
        return self.b

    @property
    def number(self) -> int:
        return self.stamp.number

    @property
    def time_ns(self) -> int:
        return self.stamp.time_ns


cdef _refuse_memory(Buffer self):
    raise XmDamagedError("the link's memory was overwritten", where=self.path,
                         expected="what its two ends wrote",
                         remedy="stop the processes that use the link, remove the file, and "
                         "find the module or program that wrote there")


cdef int _send(Out self, int64_t now_ns) except -1:
    # Not a C method: a `Writer` has the vtable of `End`, which lacks those of `Out`.
    cdef tb_buffer *b = self.ready()
    if self.converts:
        self.raw[...] = self.own
    self.stamp.number += 1
    self.stamp.time_ns = self.stamp.stamp_ns = now_ns if now_ns else tb_now()
    cdef int code = tb_write(b, self.form.bytes, &self.stamp, self.copy)
    if code < 0:
        _refuse_memory(self)
    if code:
        tb_ring(&later, &b.bell)
    return 0


cdef class Out(End):
    def begin(self) -> None:
        if self.outside is None:
            self.stamp.number, self.stamp.source = self.standing()
        else:
            self.stamp.number, self.stamp.source = self.outside.ask(self.standing)

    def standing(self) -> tuple:
        return tb_number(self.open().word), self.b.source

    def write(self, int64_t now_ns=0) -> None:
        if self.outside is None:
            _send(self, now_ns)
        elif self.played():
            self.outside.ask(None, default=None)
            self.stamp.number += 1
            self.stamp.time_ns = self.stamp.stamp_ns = now_ns
        else:
            try:
                _send(self, now_ns)
            except BaseException as error:
                self.outside.failed(error)
                raise
            self.outside.calls += 1

    @property
    def time_ns(self) -> int:
        if self.outside is None:
            return self.stamp.time_ns
        return self.outside.ask(self.written_ns)

    def written_ns(self) -> int:
        return self.stamp.time_ns

    def take(self, bytes message, int64_t now_ns, offset_ns, int64_t error_ns=0, *,
             bint turned=False) -> bool:
        cdef tb_buffer *b = self.ready()
        cdef const uint8_t *at = <const uint8_t *>PyBytes_AS_STRING(message)
        cdef const uint8_t *values
        cdef tb_head head
        cdef int64_t written, offset = 0 if offset_ns is None else offset_ns
        cdef int code = tb_unpack(at, len(message), &head)
        if not code:
            code = tb_written(&head, now_ns, offset_ns is not None, offset, error_ns,
                              &written)
        if code:
            _refuse_message(code, &head, len(message))
        if not turned and not tb_fits(&self.form, at, &head):
            return False
        if <uint64_t>len(message) != sizeof(tb_head) + head.text_bytes + self.form.bytes:
            raise ProtocolError("the record is cut short", where=self.path,
                                remedy="run the same pbonet version on every machine")
        self.stamp = tb_stamp(number=head.number & 0xffffffffffffff, source=head.source,
                              time_ns=written, stamp_ns=head.stamp_ns)
        values = at + sizeof(tb_head) + head.text_bytes
        if turned:
            values = <const uint8_t *>self.copy
        code = tb_write(b, self.form.bytes, &self.stamp, values)
        if code < 0:
            _refuse_memory(self)
        if code:
            tb_wake(&b.bell)
        return True


cdef class In(End):
    cdef bint met               # it has read something
    cdef tb_pace pace
    cdef readonly unsigned long long lost, restarts

    def read(self) -> bool:
        cdef uint64_t number = self.stamp.number, source = self.stamp.source
        if not self.fetch():
            return False
        if self.met and source != self.stamp.source:
            self.restarts += 1
        elif self.met and self.stamp.number > number:
            self.lost += self.stamp.number - number - 1
        self.met = True
        if self.converts:
            self.own[...] = self.raw
        return True

    cdef bint fetch(self) except -1:
        """Copy the newest record, or replay it from a log; False: nothing new."""
        cdef bint new = False
        if self.outside is None:
            return self.fetch_own()
        if self.outside.player is not None:
            return self.play(self.outside.ask(None, default=b""))
        try:
            new = self.fetch_own()
        except BaseException as error:
            self.outside.failed(error)
            raise
        self.outside.calls += 1
        if new and self.outside.recording():
            self.outside.put(TAPE_RAW, &self.stamp, sizeof(tb_stamp), self.copy,
                             self.form.bytes)
        return new

    cdef bint fetch_own(self) except -1:
        cdef int code = tb_read(self.ready(), self.form.bytes, &self.stamp, self.copy,
                                not self.met)
        if code < 0:
            _refuse_memory(self)
        return code

    cdef bint play(self, bytes heard) except -1:
        if not heard:
            return False
        if len(heard) != sizeof(tb_stamp) + self.raw.nbytes:
            raise ValueError("this record does not fit the link's")
        cdef const char *at = heard
        memcpy(&self.stamp, at, sizeof(tb_stamp))
        memcpy(self.copy, at + sizeof(tb_stamp), self.raw.nbytes)
        return True

    def wait(self, until_ns=None) -> bool:
        if self.outside is None:
            return self.sleep(until_ns)
        return self.outside.ask(self.sleep, until_ns)

    def sleep(self, until_ns) -> bool:
        cdef tb_buffer *b = self.ready()
        cdef int64_t until = FOREVER if until_ns is None else until_ns, now, look
        cdef int code
        while True:
            now = tb_now()
            look = min(until, now + LOOK_NS)
            with nogil:
                code = tb_doze(b, look if look > 0 else 1)
            self.ready()
            if code == 0:
                return True
            if code == TB_SIGNAL:
                PyErr_CheckSignals()
            elif look == until:
                return False

    def message(self, int64_t until_ns):
        cdef tb_buffer *b = self.ready()
        cdef uint64_t lost = self.lost
        if not self.read():
            with nogil:
                tb_doze_paced(b, &self.pace, until_ns)
            if not self.read():
                return None
        tb_paced(&self.pace, self.stamp.time_ns, self.lost - lost)
        packed = PyBytes_FromStringAndSize(NULL, tb_message_bytes(&self.form))
        tb_pack(&self.form, &self.stamp, self.copy, tb_now(),
                <uint8_t *>PyBytes_AS_STRING(packed))
        return packed

    @property
    def stamp_ns(self) -> int:
        return self.stamp.stamp_ns

    def age_ns(self, int64_t now_ns=0):
        if not self.stamp.number:
            return None
        if not now_ns:
            now_ns = tb_now() if self.outside is None else self.outside.ask(_now)
        return now_ns - self.stamp.time_ns
