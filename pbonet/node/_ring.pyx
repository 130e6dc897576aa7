# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = ring.h
"""The ring of cycle records, seen from Python; `_ring.pyi` says what everything does."""

import contextlib
import fcntl
import mmap
import os

from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport uint64_t
from libc.string cimport memset

from pbonet.errors import NodeError, RealTimeError

MADV_POPULATE_WRITE = 23  # Linux 5.14; MAP_POPULATE makes pages present to read only


def _path(str name) -> str:
    folder = os.environ.get("PBONET_SHM_DIR", "/dev/shm")
    return os.path.join(folder, f"pbonet.{os.geteuid()}.{name}.ring")


class Record:
    """One cycle, out of a ring; `_ring.pyi` says what the fields are."""

    __slots__ = ("cycle", "release_ns", "start_ns", "end_ns", "cpu_ns", "flags",
                 "stable", "consumed", "data")


cdef class Ring:
    @staticmethod
    def create(str name, capacity=1 << 20):
        if not 1 <= len(name) <= 100 or "/" in name:
            raise ValueError(f"ring name {name!r} is not 1 to 100 characters without /")
        if not 1 <= capacity <= 1 << 32:
            raise ValueError(f"capacity {capacity} is not within 1 to {1 << 32}")
        size = 1 << max(12, (int(capacity) - 1).bit_length())
        path = _path(name)
        try:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(path)
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            try:
                os.posix_fallocate(fd, 0, sizeof(ring) + size)
            except OSError:
                os.close(fd)
                os.unlink(path)
                raise
        except OSError as error:
            raise RealTimeError("the ring cannot be made", where=path, got=error.strerror,
                                expected=f"{sizeof(ring) + size} bytes",
                                remedy="make room there") from None
        cdef Ring self = _map_ring(name, path, fd)
        ring_init(self.r, size)
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
        cdef bint good = self.view.shape[0] > <Py_ssize_t>sizeof(ring)
        if good:
            good = (self.r.magic == RING_MAGIC and self.r.version == RING_VERSION
                    and self.r.capacity == self.view.shape[0] - sizeof(ring))
        if not good:
            self.close()
            raise NodeError("the file is no ring, or of another version", where=self.path)
        return self

    cdef ring *open(self) except NULL:
        if self.r is NULL:
            raise NodeError("the ring is closed", where=self.path)
        return self.r

    @property
    def lost(self) -> int:
        return ring_lost(self.open())

    def put(self, const unsigned char[::1] data, *, uint64_t cycle=0) -> bool:
        cdef ring_record r
        memset(&r, 0, sizeof(r))
        r.cycle = cycle
        r.bytes = data.shape[0]
        return bool(ring_put(self.open(), &r, NULL, &data[0] if r.bytes else NULL))

    def drain(self, limit=0) -> list:
        if not self.consumer:
            self.claim()
        cdef uint64_t n = ring_ready(self.open()), at = 0
        if n > self.r.capacity:
            raise NodeError("the ring is damaged", where=self.path)
        cdef bytes copy = PyBytes_FromStringAndSize(NULL, n)
        cdef char *text = copy
        ring_look(self.r, text, n)
        records = []
        while at < n and (not limit or len(records) < limit):
            at += self.parse(text + at, n - at, records)
        ring_done(self.r, at)
        return records

    cdef uint64_t parse(self, const char *text, uint64_t n, list records) except 0:
        cdef const ring_record *r = <const ring_record *>text
        cdef const uint64_t *pairs = <const uint64_t *>(text + sizeof(ring_record))
        cdef uint64_t k, head = sizeof(ring_record)
        if n < head or r.size > n or r.size < head + 16 * r.n_consumed + r.bytes:
            raise NodeError("the ring is damaged", where=self.path)
        record = Record()
        record.cycle = r.cycle
        record.release_ns = r.release_ns
        record.start_ns = r.start_ns
        record.end_ns = r.end_ns
        record.cpu_ns = r.cpu_ns
        record.flags = r.flags & ~RING_STABLE
        record.stable = bool(r.flags & RING_STABLE)
        record.consumed = tuple([(pairs[2 * k], pairs[2 * k + 1])
                                 for k in range(r.n_consumed)])
        record.data = (text + head + 16 * r.n_consumed)[:r.bytes]
        records.append(record)
        return r.size

    cdef claim(self):
        self.open()
        try:
            fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise NodeError("somebody else drains this ring", where=self.path) from None
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
    with contextlib.suppress(OSError):  # present from the start: no cycle shall fault
        self.memory.madvise(MADV_POPULATE_WRITE)
    view = self.memory
    self.view = view
    self.r = <ring *>&view[0]
    return self
