"""What the task's slot calls without Python to append a record."""

from libc.stdint cimport int64_t, uint32_t, uint64_t


cdef extern from "ring.h" nogil:
    const uint64_t RING_MAGIC
    enum:
        RING_VERSION
    const uint32_t RING_STABLE
    struct ring:
        uint64_t magic, capacity
        uint32_t version
    struct ring_record:
        uint32_t size, n_consumed, bytes, flags
        uint64_t cycle
        int64_t release_ns, start_ns, end_ns
        uint64_t cpu_ns
    void ring_init(ring *r, uint64_t capacity)
    int ring_put(ring *r, ring_record *record, const uint64_t *consumed, const void *data)
    uint64_t ring_ready(const ring *r)
    uint64_t ring_lost(const ring *r)
    void ring_look(const ring *r, void *to, uint64_t n)
    void ring_done(ring *r, uint64_t n)


cdef class Ring:
    cdef ring *r
    cdef object memory, view
    cdef int fd
    cdef bint consumer
    cdef readonly str name, path
    cdef ring *open(self) except NULL
    cdef Ring check(self)
    cdef uint64_t parse(self, const char *text, uint64_t n, list records) except 0
    cdef claim(self)
