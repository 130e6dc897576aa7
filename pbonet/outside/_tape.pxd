"""What other native parts of pbonet call without Python."""

from libc.stdint cimport uint32_t, uint64_t, uint8_t


cdef extern from "pbonet/outside/tape.h" nogil:
    enum:
        TAPE_RAW, TAPE_PACKED, TAPE_TUPLE, TAPE_RAISED, TAPE_BROKEN, TAPE_NAME, TAPE_LOST
    struct tape_entry:
        uint32_t bytes, source
        uint64_t call
        uint8_t kind
    struct tape:
        uint64_t used, room
        unsigned char *bytes
        uint32_t lost
    uint64_t tape_size(uint64_t bytes)
    void tape_put(tape *t, tape_entry e, const void *first, uint32_t n,
                  const void *second, uint32_t m)
    uint64_t tape_ready(tape *t)
    void tape_empty(tape *t)


cdef class Tape:
    cdef tape t
    cdef readonly int opened
    cdef list sources


cdef class Outside:
    cdef Tape tape
    cdef object player
    cdef readonly str name
    cdef readonly int number
    cdef public uint64_t calls
    cdef bint recording(self)
    cdef void put(self, uint8_t kind, const void *first, uint32_t n,
                  const void *second, uint32_t m) noexcept
    cdef int failed(self, error) except -1
