"""What other native parts of pbonet call without Python."""

cdef void c_defer_bells() noexcept nogil   # a cycle begins: wake nobody within it
cdef void c_ring_bells() noexcept nogil    # it is over: wake whom it wrote to
