# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# distutils: extra_compile_args = -O2 -std=c11
"""Steps of an arm with friction and end stops; documented in `_friction.pyi`."""

import numpy as np

from libc.math cimport INFINITY, fabs, sqrt

cdef enum:
    MOST = 32           # joints
    ALL_AT_ONCE = 10    # rounds in which every wrong sign is corrected

cdef struct problem:
    int n
    double matrix[MOST][MOST]
    double push[MOST]
    double low[MOST]
    double high[MOST]


def add_damping(double[:] torque, const double[:] damping, const double[:] qd):
    cdef Py_ssize_t i
    if not torque.shape[0] == damping.shape[0] == qd.shape[0]:
        raise ValueError("torque, damping and velocity are not those of the same joints")
    for i in range(torque.shape[0]):
        torque[i] += damping[i] * qd[i]


cdef void solve(const problem *p, const int *slips, int n, double *v) noexcept nogil:
    """Solve for the velocities of the joints that slip, by Cholesky; `v` is their momenta."""
    cdef double factor[MOST][MOST]
    cdef double s
    cdef int i, j, k
    for j in range(n):
        s = p.matrix[slips[j]][slips[j]]
        for k in range(j):
            s -= factor[j][k] * factor[j][k]
        factor[j][j] = sqrt(s)
        for i in range(j + 1, n):
            s = p.matrix[slips[i]][slips[j]]
            for k in range(j):
                s -= factor[i][k] * factor[j][k]
            factor[i][j] = s / factor[j][j]
    for i in range(n):
        for k in range(i):
            v[i] -= factor[i][k] * v[k]
        v[i] /= factor[i][i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            v[i] -= factor[k][i] * v[k]
        v[i] /= factor[i][i]


cdef void with_signs(const problem *p, const int *signs, double *velocity,
                     double *friction) noexcept nogil:
    """Find velocity and friction if the joints slip, or stick, as `signs` say."""
    cdef int slips[MOST]
    cdef double v[MOST]
    cdef int i, k, n = 0
    for i in range(p.n):
        velocity[i] = 0.0
        if signs[i]:
            friction[i] = p.high[i] if signs[i] > 0 else p.low[i]
            slips[n] = i
            v[n] = p.push[i] - friction[i]
            n += 1
    solve(p, slips, n, v)
    for k in range(n):
        velocity[slips[k]] = v[k]
    for i in range(p.n):
        if not signs[i]:
            friction[i] = p.push[i]
            for k in range(n):
                friction[i] -= p.matrix[i][slips[k]] * v[k]


cdef int better(const problem *p, int i, int sign, double v, double f) noexcept nogil:
    """Return the sign that a joint's velocity should have been given."""
    cdef double slack
    if sign:
        return 0 if v * sign < 0.0 else sign
    if p.low[i] <= f <= p.high[i]:
        return 0
    slack = 1e-12 * (1.0 + fabs(p.push[i]))
    return (f > p.high[i] + slack) - (f < p.low[i] - slack)


cdef void find(const problem *p, const double *guess, int all_at_once, double *velocity) noexcept nogil:
    cdef int signs[MOST]
    cdef double friction[MOST]
    cdef int i, sign, wrong = 1, rounds = 0
    for i in range(p.n):    # nothing moves into a stop
        signs[i] = ((guess[i] > 0.0 and p.high[i] < INFINITY) -
                    (guess[i] < 0.0 and p.low[i] > -INFINITY))
    while wrong:
        with_signs(p, signs, velocity, friction)
        wrong = 0
        for i in range(p.n):
            sign = better(p, i, signs[i], velocity[i], friction[i])
            if sign != signs[i]:
                signs[i] = sign
                wrong += 1
                if rounds > all_at_once:
                    break
        rounds += 1


def solve_with_friction(matrix, push, bounds, guess, int all_at_once=ALL_AT_ONCE):
    cdef problem p
    cdef const double[:, :] m = np.asarray(matrix, np.float64)
    cdef const double[:] load = np.asarray(push, np.float64)
    cdef const double[:, :] pairs = np.asarray(bounds, np.float64)
    cdef const double[::1] first = np.ascontiguousarray(guess, np.float64)
    cdef int i, k
    p.n = checked(load.shape[0])
    must_be(m.shape[0] == m.shape[1] == pairs.shape[0] == first.shape[0] == p.n and
            pairs.shape[1] == 2, p.n)
    for i in range(p.n):
        p.push[i], p.low[i], p.high[i] = load[i], pairs[i, 0], pairs[i, 1]
        for k in range(p.n):
            p.matrix[i][k] = m[i, k]
    velocity = np.zeros(p.n)
    cdef double[::1] out = velocity
    find(&p, &first[0], all_at_once, &out[0])
    return velocity


cdef int checked(Py_ssize_t n) except -1:
    if not 1 <= n <= MOST:
        raise ValueError(f"{n} joints are not 1 to {MOST}")
    return <int>n


cdef int must_be(bint fits, int n) except -1:
    if not fits:
        raise ValueError(f"the equations are not those of {n} joints")
    return 0


cdef class FrictionStep:
    cdef double[::1] q, qd, torque
    cdef const double[::1] viscous, down, up, lower, upper
    cdef int n

    def __init__(self, q, qd, torque, *, viscous, down, up, lower, upper):
        self.n = checked(len(q))
        numbers = [np.array(one, np.float64) for one in (viscous, down, up, lower, upper)]
        must_be(all([np.shape(one) == (self.n,) for one in (q, qd, torque, *numbers)]), self.n)
        self.q, self.qd, self.torque = q, qd, torque
        self.viscous, self.down, self.up, self.lower, self.upper = numbers

    def advance(self, const double[:, :] mass, const double[:] bias, double h) -> None:
        cdef problem p
        cdef double velocity[MOST]
        cdef int i, k
        must_be(mass.shape[0] == mass.shape[1] == bias.shape[0] == self.n, self.n)
        p.n = self.n
        for i in range(self.n):
            p.push[i] = h * (self.torque[i] - bias[i])
            for k in range(self.n):
                p.matrix[i][k] = mass[i, k]
                p.push[i] += mass[i, k] * self.qd[k]
            p.matrix[i][i] += h * self.viscous[i]
            p.low[i] = -INFINITY if self.q[i] <= self.lower[i] else -h * self.down[i]
            p.high[i] = INFINITY if self.q[i] >= self.upper[i] else h * self.up[i]
        find(&p, &self.qd[0], ALL_AT_ONCE, velocity)
        for i in range(self.n):
            self.qd[i] = velocity[i]
            self.q[i] = max(min(self.q[i] + h * velocity[i], self.upper[i]), self.lower[i])
