"""Functions that the task's slot calls without Python to append a record."""

from libc.stdint cimport int64_t, uint32_t, uint64_t


cdef extern from "pbonet/node/ring/ring.h" nogil:
    enum:
        RING_SYNC
    const uint32_t RING_HELD, RING_SAFE, RING_STABLE
    struct ring_file:
        pass
    struct ring:
        ring_file *file
        uint64_t capacity
    struct ring_record:
        uint32_t size, n_consumed, bytes, in_bytes, heard_bytes
        uint64_t cycle
        int64_t release_ns, start_ns, end_ns, dt_ns
        uint64_t cpu_ns, uid, number, lost
        uint32_t flags, kind
    void ring_init(ring *r, uint64_t capacity, uint32_t about)
    bint ring_use(ring *r, uint64_t bytes)
    enum:
        RING_WANT_NEW
        RING_WANT_ALL
    uint32_t ring_wants(const ring *r)
    void ring_want(ring *r, uint32_t bits)
    void ring_wanted(ring *r)
    int ring_fits(const ring *r, const ring_record *record)
    void ring_stage(ring *r, const ring_record *record, uint64_t at, const void *src,
                    uint64_t n)
    int ring_put(ring *r, ring_record *record, const uint64_t *consumed, const void *data,
                 const void *heard)
    uint64_t ring_ready(const ring *r)
    uint64_t ring_lost(const ring *r)
    void ring_look(const ring *r, void *to, uint64_t n)
    void ring_done(ring *r, uint64_t n)


cdef class Ring:
    cdef ring own
    cdef ring *r               # `own`; NULL: closed
    cdef object memory, view
    cdef int fd
    cdef bint consumer
    cdef readonly str name, path
    cdef ring *open(self) except NULL
    cdef Ring check(self)
    cdef bytes copy(self)
    cdef claim(self)
