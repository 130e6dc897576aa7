# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: depends = numbers.h
"""Numbers that are copied where they stand in messages; documented in `_numbers.pyi`."""

from cpython.bytearray cimport PyByteArray_AS_STRING
from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from libc.stdint cimport int64_t, uint32_t, uintptr_t
from libc.string cimport memcpy

cdef extern from "numbers.h":
    ctypedef void ros_copy(double *, const char *, const uint32_t *, size_t) noexcept
    ros_copy *ros_copy_of(char kind, size_t bytes)
    struct ros_part:
        size_t at, n
        const void *from_ "from"
        double *to
        const uint32_t *order
        ros_copy *copy
    bint ros_same(const char *, const char *, const char *mask, size_t)
    bint ros_take(const ros_part *, const char *message)
    void ros_put_time(char *at, int64_t ns)
    int64_t ros_time(const char *at)

cdef size_t TIME = 8            # bytes


cdef void *room(list kept, size_t bytes):
    """Return memory that lives as long as the list."""
    made = bytearray(bytes + 1)
    kept.append(made)
    return PyByteArray_AS_STRING(made)


cdef must_fit(bint fits, what):
    if not fits:
        raise ValueError(f"{what} do not fit the message")


cdef class Filler:
    cdef bytearray message
    cdef list kept
    cdef ros_part *parts
    cdef size_t *stamps
    cdef size_t n, n_stamps

    def __init__(self, bytearray message not None, list parts not None,
                 list stamps not None):
        cdef size_t i, size = len(message)
        self.message, self.kept = message, [parts]
        self.n, self.n_stamps = len(parts), len(stamps)
        self.parts = <ros_part *>room(self.kept, self.n * sizeof(ros_part))
        self.stamps = <size_t *>room(self.kept, self.n_stamps * sizeof(size_t))
        for i, (at, source) in enumerate(parts):
            must_fit(source.flags.c_contiguous and at + source.nbytes <= size, "numbers")
            self.parts[i].at, self.parts[i].n = at, source.nbytes
            self.parts[i].from_ = <const void *><uintptr_t>source.ctypes.data
        for i, at in enumerate(stamps):
            must_fit(at + TIME <= size, "stamps")
            self.stamps[i] = at

    def fill(self, int64_t stamp_ns) -> bytes:
        cdef size_t i
        made = PyBytes_FromStringAndSize(PyByteArray_AS_STRING(self.message),
                                         len(self.message))
        cdef char *to = PyBytes_AS_STRING(made)
        for i in range(self.n):
            memcpy(to + self.parts[i].at, self.parts[i].from_, self.parts[i].n)
        for i in range(self.n_stamps):
            ros_put_time(to + self.stamps[i], stamp_ns)
        return made


cdef class Taker:
    cdef bytes mask, rest
    cdef list kept
    cdef ros_part *parts
    cdef size_t n
    cdef Py_ssize_t stamp
    cdef readonly int64_t stamp_ns

    def __init__(self, bytes mask not None, bytes rest not None, list parts not None,
                 to not None, Py_ssize_t stamp):
        cdef size_t i, size = len(mask)
        self.mask, self.rest, self.kept, self.stamp = mask, rest, [parts, to], stamp
        self.n = len(parts)
        self.parts = <ros_part *>room(self.kept, self.n * sizeof(ros_part))
        must_fit(len(rest) == len(mask), "the bytes that stay")
        must_fit(stamp < 0 or stamp + TIME <= size, "stamps")
        for i, (first, end, at, count, dtype, order) in enumerate(parts):
            must_fit(at + count * dtype.itemsize <= size and 0 <= first <= end <= to.size
                     and to.dtype == float and to.flags.c_contiguous, "numbers")
            self.parts[i].at, self.parts[i].n = at, end - first
            self.parts[i].to = <double *><uintptr_t>to.ctypes.data + <size_t>first
            self.parts[i].copy = ros_copy_of(ord(dtype.kind), dtype.itemsize)
            must_fit(self.parts[i].copy is not NULL, f"numbers of type {dtype}")
            if order is None:
                must_fit(end - first == count, "numbers")
                continue
            must_fit(order.dtype == "u4" and order.flags.c_contiguous
                     and len(order) == end - first and order.max() < count, "an order")
            self.parts[i].order = <const uint32_t *><uintptr_t>order.ctypes.data

    def take(self, bytes data not None) -> bool:
        cdef const char *at = PyBytes_AS_STRING(data)
        cdef size_t i
        cdef bint finite = True
        if len(data) != len(self.mask) or not ros_same(
                at, PyBytes_AS_STRING(self.rest), PyBytes_AS_STRING(self.mask), len(data)):
            return False
        for i in range(self.n):
            finite &= ros_take(self.parts + i, at)
        if self.stamp >= 0:
            self.stamp_ns = ros_time(at + self.stamp)
        return finite
