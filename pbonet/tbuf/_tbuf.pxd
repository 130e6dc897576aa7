"""Functions that other native parts of pbonet call without Python."""

cdef void c_defer_bells() noexcept nogil   # a cycle begins: defer wake-ups
cdef void c_ring_bells() noexcept nogil    # it has ended: wake the readers it wrote to
