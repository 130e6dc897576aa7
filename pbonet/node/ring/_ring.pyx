# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = ring.h
"""Python interface of the ring of cycle records; documented in `_ring.pyi`."""

import contextlib
import fcntl
import mmap
import os

from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport uint64_t
from libc.string cimport memset

from pbonet import shm
from pbonet.errors import NodeError, RealTimeError

MADV_POPULATE_WRITE = 23  # Linux 5.14; MAP_POPULATE makes pages present for reading only


def _path(str name) -> str:
    return str(shm.path_of(f"{name}.ring"))


class Record:
    """One record of a ring; the fields are documented in `_ring.pyi`."""

    __slots__ = ("cycle", "release_ns", "start_ns", "end_ns", "dt_ns", "cpu_ns", "uid",
                 "number", "lost", "flags", "kind", "stable", "consumed", "data", "inputs", "heard")


def parse(const unsigned char[::1] text not None) -> list:
    cdef uint64_t at = 0, n = text.shape[0]
    records = []
    while at < n:
        at += _parse(<const char *>&text[at], n - at, records)
    return records


cdef uint64_t _parse(const char *text, uint64_t n, list records) except 0:
    cdef const ring_record *r = <const ring_record *>text
    cdef const uint64_t *pairs
    cdef uint64_t k, head = sizeof(ring_record)
    if n < head or r.size > n or r.size < (head + 16 * <uint64_t>r.n_consumed +
                                           r.bytes + r.in_bytes + r.heard_bytes):
        raise NodeError("the ring is damaged")
    pairs = <const uint64_t *>(text + head + r.bytes)
    record = Record()
    record.cycle = r.cycle
    record.release_ns = r.release_ns
    record.start_ns = r.start_ns
    record.end_ns = r.end_ns
    record.dt_ns = r.dt_ns
    record.cpu_ns = r.cpu_ns
    record.uid = r.uid
    record.number = r.number
    record.lost = r.lost
    record.flags = r.flags & ~RING_STABLE
    record.kind = r.kind
    record.stable = bool(r.flags & RING_STABLE)
    record.consumed = tuple([(pairs[2 * k], pairs[2 * k + 1])
                             for k in range(r.n_consumed)])
    record.data = (text + head)[:r.bytes]
    text += head + r.bytes + 16 * <uint64_t>r.n_consumed
    record.inputs = text[:r.in_bytes]
    record.heard = (text + r.in_bytes)[:r.heard_bytes]
    records.append(record)
    return r.size


cdef class Ring:
    @staticmethod
    def create(str name, capacity=1 << 20, bytes about=b""):
        if not 1 <= len(name) <= 100 or "/" in name:
            raise ValueError(f"ring name {name!r} is not 1 to 100 characters without /")
        if len(about) > 1 << 24:
            raise ValueError(f"{len(about)} bytes about a ring are too many")
        if not 1 <= capacity <= 1 << 32:
            raise ValueError(f"capacity {capacity} is not within 1 to {1 << 32}")
        size = 1 << max(12, (int(capacity) - 1).bit_length())
        path = _path(name)
        try:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(path)
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            try:
                os.posix_fallocate(fd, 0, sizeof(ring_file) + size + len(about))
            except OSError:
                os.close(fd)
                os.unlink(path)
                raise
        except OSError as error:
            raise RealTimeError("the ring cannot be made", where=path, got=error.strerror,
                                expected=f"{sizeof(ring_file) + size + len(about)} bytes",
                                remedy="make room there") from None
        cdef Ring self = _map_ring(name, path, fd)
        if about:
            self.memory[sizeof(ring_file) + size:] = about
        ring_init(self.r, size, len(about))
        return self

    @staticmethod
    def attach(str name):
        path = _path(name)
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except OSError as error:
            raise NodeError("the ring cannot be opened", where=path,
                            got=error.strerror) from None
        return _map_ring(name, path, fd).check()

    cdef Ring check(self):
        if not ring_use(self.r, self.view.shape[0]):
            self.close()
            raise NodeError("the file is not a ring, or is of another version", where=self.path)
        return self

    cdef ring *open(self) except NULL:
        if self.r is NULL:
            raise NodeError("the ring is closed", where=self.path)
        return self.r

    @property
    def lost(self) -> int:
        return ring_lost(self.open())

    @property
    def about(self) -> bytes:
        return bytes(self.memory[sizeof(ring_file) + self.open().capacity:])

    def put(self, const unsigned char[::1] data, *, uint64_t cycle=0, unsigned kind=0,
            int64_t now_ns=0, uint64_t uid=0, uint64_t number=0) -> bool:
        cdef ring_record r
        memset(&r, 0, sizeof(r))
        r.cycle, r.kind, r.uid, r.number = cycle, kind, uid, number
        r.release_ns = r.start_ns = r.end_ns = now_ns
        r.bytes = data.shape[0]
        return bool(ring_put(self.open(), &r, NULL, &data[0] if r.bytes else NULL, NULL))

    def want(self, *, bint always=False) -> None:
        ring_want(self.open(), RING_WANT_ALL if always else RING_WANT_NEW)

    def drain(self, limit=0) -> list:
        cdef bytes copy = self.copy()
        cdef const char *text = copy
        cdef uint64_t n = len(copy), at = 0
        records = []
        while at < n and (not limit or len(records) < limit):
            at += _parse(text + at, n - at, records)
        ring_done(self.r, at)
        return records

    def take(self) -> bytes:
        cdef bytes copy = self.copy()
        ring_done(self.r, len(copy))
        return copy

    cdef bytes copy(self):
        """Return the waiting records, and leave them in the ring."""
        if not self.consumer:
            self.claim()
        cdef uint64_t n = ring_ready(self.open())
        if n > self.r.capacity:
            raise NodeError("the ring is damaged", where=self.path)
        cdef bytes copy = PyBytes_FromStringAndSize(NULL, n)
        ring_look(self.r, <char *>copy, n)
        return copy

    cdef claim(self):
        self.open()
        try:
            fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise NodeError("another process drains this ring", where=self.path) from None
        self.consumer = True

    def close(self) -> None:
        if self.memory is not None:
            self.r = NULL
            self.view = None
            self.memory.close()
            self.memory = None
            os.close(self.fd)

    def destroy(self) -> None:
        self.close()
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.path)

    def __dealloc__(self):
        if self.r is not NULL:
            self.r = NULL
            os.close(self.fd)


cdef Ring _map_ring(str name, str path, int fd):
    cdef Ring self = Ring.__new__(Ring)
    cdef unsigned char[::1] view
    self.name, self.path, self.fd = name, path, fd
    self.memory = mmap.mmap(fd, os.fstat(fd).st_size)
    with contextlib.suppress(OSError):  # present from the start: no page faults in a cycle
        self.memory.madvise(MADV_POPULATE_WRITE)
        self.memory.madvise(mmap.MADV_DONTFORK)  # a module may fork
    view = self.memory
    self.view = view
    self.own.file = <ring_file *>&view[0]
    self.r = &self.own
    return self
