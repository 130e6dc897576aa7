# cython: language_level=3, boundscheck=False, wraparound=False
"""Finds the records in an uncompressed chunk; documented in `_walk.pyi`."""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from libc.stdint cimport int64_t, uint16_t, uint64_t
from libc.string cimport memcpy

cdef enum:
    HEAD = 9  # opcode and size
    MESSAGE = 5
    MESSAGE_HEAD = 22


cdef Py_ssize_t _go(const char *data, Py_ssize_t size, int64_t *rows) noexcept:
    """Fill in a row for each record, if there is room for them; return their number.

    -1: a record does not fit.
    """
    cdef Py_ssize_t at = 0, count = 0
    cdef uint64_t length
    cdef uint16_t channel
    cdef unsigned char opcode
    while at < size:
        if size - at < HEAD:
            return -1
        opcode = <unsigned char>data[at]
        memcpy(&length, data + at + 1, 8)
        at += HEAD
        if length > <uint64_t>(size - at) or (opcode == MESSAGE and length < MESSAGE_HEAD):
            return -1
        if rows:
            channel = 0
            if length >= 2:
                memcpy(&channel, data + at, 2)
            rows[4 * count] = opcode
            rows[4 * count + 1] = channel
            rows[4 * count + 2] = at
            rows[4 * count + 3] = <int64_t>length
        at += <Py_ssize_t>length
        count += 1
    return count


def walk(bytes data not None):
    cdef const char *text = PyBytes_AS_STRING(data)
    cdef Py_ssize_t size = len(data), count = _go(text, size, NULL)
    cdef bytes rows
    if count < 0:
        return None
    rows = PyBytes_FromStringAndSize(NULL, count * 4 * sizeof(int64_t))
    _go(text, size, <int64_t *>PyBytes_AS_STRING(rows))
    return rows
