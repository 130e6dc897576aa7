"""Functions that other native parts of pbonet call without Python."""

# Address of this thread's struct xm_steady, which counts its uninterruptible sections.
cdef void *c_steady() noexcept nogil
