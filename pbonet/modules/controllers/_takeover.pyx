# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# distutils: extra_compile_args = -O2 -std=c11
"""The way from the value of a variable to the one of a law; documented in `_takeover.pyi`."""

import numpy as np

from libc.math cimport INFINITY


cdef class Takeover:
    cdef double[::1] value, offset, low, high
    cdef bint begins
    cdef double time

    def __init__(self, value):
        self.value = value
        self.offset = np.zeros(len(value))
        self.bound(-INFINITY, INFINITY)
        self.begins = False

    def bound(self, low, high):
        self.low, self.high = np.empty((2, self.value.shape[0]))
        np.asarray(self.low)[:], np.asarray(self.high)[:] = low, high

    def begin(self):
        self.begins, self.time = True, 0.0

    def apply(self, const double[:] law, double dt, double fade):
        cdef double rest = 0.0, x
        cdef Py_ssize_t i
        if law.shape[0] != self.value.shape[0]:
            raise ValueError(f"a law has {law.shape[0]} elements, its variable {self.value.shape[0]}")
        if self.begins:
            for i in range(self.value.shape[0]):
                self.offset[i] = self.value[i] - law[i]
        else:
            self.time += dt
            if self.time < fade:
                x = self.time / fade
                rest = 1.0 - x * x * (3.0 - 2.0 * x)
            for i in range(self.value.shape[0]):
                self.value[i] = rest * self.offset[i] + law[i] if rest else law[i]
        self.begins = False
        for i in range(self.value.shape[0]):
            if self.value[i] < self.low[i]:
                self.value[i] = self.low[i]
            if self.value[i] > self.high[i]:
                self.value[i] = self.high[i]
