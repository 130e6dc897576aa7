# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# distutils: extra_compile_args = -O2 -std=c11 -ffp-contract=off
"""Joints and base of a robot in MuJoCo's memory; documented in `_mujoco_memory.pyi`."""

from libc.math cimport fabs


cdef class JointMemory:
    cdef const double[::1] at, rates, all_rates
    cdef double[::1] applied, q, qd, torque
    cdef const double[::1] low, high
    cdef const Py_ssize_t[::1] order

    def __init__(self, data, order, bounds, q, qd, torque):
        cdef Py_ssize_t n = len(order)
        self.order = order
        self.at, self.rates, self.applied = data.qpos[-n:], data.qvel[-n:], data.qfrc_applied[-n:]
        self.all_rates = data.qvel
        self.low, self.high = bounds
        self.q, self.qd, self.torque = q, qd, torque
        sizes = {n, len(q), len(qd), len(torque), self.at.shape[0], self.low.shape[0]}
        if sizes != {n} or sorted(order) != list(range(n)):
            raise ValueError("the arrays are not those of the joints, each once")

    def read(self, double limit):
        cdef Py_ssize_t i
        for i in range(self.order.shape[0]):
            self.q[i] = self.at[self.order[i]]
            self.qd[i] = self.rates[self.order[i]]
        for i in range(self.all_rates.shape[0]):
            if not fabs(self.all_rates[i]) < limit:
                return i
        return -1

    def command(self, const double[:] wish):
        cdef Py_ssize_t i
        cdef double one
        if wish.shape[0] != self.order.shape[0]:
            raise ValueError("it is not a torque for each joint")
        for i in range(self.order.shape[0]):
            one = wish[i]
            if one > self.high[i]:
                one = self.high[i]
            if one < self.low[i]:
                one = self.low[i]
            self.torque[i] = self.applied[self.order[i]] = one


cdef class BaseMemory:
    cdef const double[::1] place, rates
    cdef const double[:, ::1] turned

    def __init__(self, data, Py_ssize_t body):
        self.place, self.rates = data.qpos[:3], data.qvel[:6]
        self.turned = data.xmat[body].reshape(3, 3)

    def read(self, double[:, :] pose, double[:] velocity):
        cdef const double *w = &self.rates[3]
        cdef Py_ssize_t i, k
        if (pose.shape[0], pose.shape[1], velocity.shape[0]) != (3, 4, 6):
            raise ValueError("a pose is [3, 4], and its velocity [6]")
        for i in range(3):
            for k in range(3):
                pose[i, k] = self.turned[i, k]
            pose[i, 3], velocity[i] = self.place[i], self.rates[i]
            velocity[3 + i] = (self.turned[i, 0] * w[0] + self.turned[i, 1] * w[1] +
                               self.turned[i, 2] * w[2])
