"""What other native parts of pbonet call without Python."""

# Where this thread counts sections in which it must not be held: struct xm_steady.
cdef void *c_steady() noexcept nogil
