# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# distutils: extra_compile_args = -O2 -std=c11 -ffp-contract=off
"""Arithmetic of poses, and steps towards them; documented in `_poses.pyi`."""

import numpy as np

from cpython.buffer cimport (
    PyBUF_C_CONTIGUOUS, PyBUF_FORMAT, PyBUF_STRIDES, PyBUF_WRITABLE, PyBuffer_Release, PyObject_GetBuffer
)
from libc.math cimport M_PI, atan2, fabs, isfinite, sin, sqrt

cdef enum:
    BASE = 7        # elements of pinocchio's position before the joints
    RATES = 6       # the same of its velocity

cdef double SMALL = 1e-9
cdef double NEARLY = 1e-6
cdef double FLAT = 1e-3     # below it, twice a sine gives no axis of full precision

cdef struct motion:
    double way[3]       # m
    double turn[3]      # axis times angle, rad


# ------------------------------------------------------------------- numbers of arrays

cdef int copy(object array, Py_ssize_t rows, Py_ssize_t columns, double *to,
              bint back=False) except -1:
    """Copy numbers of an array to memory, or back; of a matrix the first rows."""
    cdef Py_buffer view
    cdef Py_ssize_t i, k
    cdef char *row
    PyObject_GetBuffer(array, &view, PyBUF_STRIDES | PyBUF_FORMAT | (PyBUF_WRITABLE if back else 0))
    try:
        if (view.format is NULL or view.format[0] != b"d" or view.ndim != (2 if rows else 1)
                or view.shape[view.ndim - 1] != columns or view.shape[0] < rows):
            wanted = f"[{rows}, {columns}]" if rows else f"[{columns}]"
            raise ValueError(f"an array is not float64 of the size {wanted}")
        for i in range(rows or 1):
            row = <char *>view.buf + i * (view.strides[0] if rows else 0)
            for k in range(columns):
                if back:
                    (<double *>(row + k * view.strides[view.ndim - 1]))[0] = to[i * columns + k]
                else:
                    to[i * columns + k] = (<double *>(row + k * view.strides[view.ndim - 1]))[0]
    finally:
        PyBuffer_Release(&view)
    return 0


cdef object matrix(const double *numbers, Py_ssize_t rows, Py_ssize_t columns):
    """Return numbers as an array; one row makes a vector."""
    cdef object found = np.empty((rows, columns)) if rows > 1 else np.empty(columns)
    copy(found, rows if rows > 1 else 0, columns, <double *>numbers, True)
    return found


cdef bint is_finite(object numbers) except -1:
    cdef Py_buffer view
    cdef Py_ssize_t i
    cdef const double *first
    cdef bint good = True
    PyObject_GetBuffer(numbers, &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT)
    try:
        if view.format is NULL or view.format[0] != b"d":
            raise ValueError("an array is not float64")
        first = <const double *>view.buf
        for i in range(view.len // view.itemsize):
            good = good and isfinite(first[i])
    finally:
        PyBuffer_Release(&view)
    return good


def all_finite(*arrays):
    for numbers in arrays:
        if not is_finite(numbers):
            return False
    return True


# ----------------------------------------------------------------------------- turning

cdef void by_turn(double x, double y, double z, double *m) noexcept nogil:
    """Write the rotation matrix of a turn, row by row (Rodrigues)."""
    cdef double square = x * x + y * y + z * z, angle, s, c
    if square < SMALL * SMALL:
        m[0], m[1], m[2] = 1.0, -z, y
        m[3], m[4], m[5] = z, 1.0, -x
        m[6], m[7], m[8] = -y, x, 1.0
        return
    angle = sqrt(square)
    s = sin(angle) / angle
    c = 2.0 * (sin(0.5 * angle) / angle) * (sin(0.5 * angle) / angle)
    m[0] = 1.0 - c * (y * y + z * z)
    m[1] = c * x * y - s * z
    m[2] = c * x * z + s * y
    m[3] = c * x * y + s * z
    m[4] = 1.0 - c * (x * x + z * z)
    m[5] = c * y * z - s * x
    m[6] = c * x * z - s * y
    m[7] = c * y * z + s * x
    m[8] = 1.0 - c * (x * x + y * y)


cdef void near_half(const double *m, double cosine, double *turn) noexcept nogil:
    """Make a turn of nearly pi of twice its sine along its axis, which says too little."""
    cdef int i, column = 0
    cdef double axis[3]
    cdef double square = 0.0, along = 0.0, size = 0.0, factor
    for i in range(1, 3):
        if m[4 * i] > m[4 * column]:
            column = i
    for i in range(3):      # the symmetric part is cosine * 1 + (1 - cosine) * axis axis^T
        axis[i] = 0.5 * (m[3 * i + column] + m[3 * column + i]) - cosine * (i == column)
        square += axis[i] * axis[i]
        along += axis[i] * turn[i]
        size += turn[i] * turn[i]
    factor = atan2(0.5 * sqrt(size), cosine) / sqrt(square)
    for i in range(3):
        turn[i] = axis[i] * (-factor if along < 0.0 else factor)


cdef void turn_from(const double *m, double *turn) noexcept nogil:
    """Write the turn of a rotation matrix: axis times angle, at most pi."""
    cdef double cosine = 0.5 * (m[0] + m[4] + m[8] - 1.0), size, factor
    cdef int i
    turn[0], turn[1], turn[2] = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    size = sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    if cosine < 0.0 and size < FLAT:
        near_half(m, cosine, turn)
        return
    factor = atan2(0.5 * size, cosine) / size if size > SMALL else 0.5
    for i in range(3):
        turn[i] *= factor


cdef motion between(const double *wanted, const double *pose) noexcept nogil:
    """Return what takes a pose to the wanted one, both as [R p], [3, 4]."""
    cdef motion found
    cdef double m[9]
    cdef int i, j
    for i in range(3):
        found.way[i] = wanted[4 * i + 3] - pose[4 * i + 3]
        for j in range(3):
            m[3 * i + j] = (wanted[4 * i] * pose[4 * j] + wanted[4 * i + 1] * pose[4 * j + 1] +
                            wanted[4 * i + 2] * pose[4 * j + 2])
    turn_from(m, found.turn)
    return found


cdef motion to_goal(const double[:, :] goal, const double *at) noexcept nogil:
    """Return what takes a pose to a goal, whose first three rows count."""
    cdef double wanted[12]
    cdef int i, j
    for i in range(3):
        for j in range(4):
            wanted[4 * i + j] = goal[i, j]
    return between(wanted, at)


cdef double shortened(double *v, double limit) noexcept nogil:
    """Shorten a vector to a limit; return how long it is then."""
    cdef double size = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    cdef int i
    if not size > limit:
        return size
    for i in range(3):
        v[i] *= limit / size
    return limit


cdef bint is_turn(const double *r) noexcept nogil:
    """Return whether the first three columns of [R p] are a rotation, to 1e-6."""
    cdef double off = 0.0, one
    cdef int i, j
    for i in range(3):
        for j in range(i, 3):
            one = r[4 * i] * r[4 * j] + r[4 * i + 1] * r[4 * j + 1] + r[4 * i + 2] * r[4 * j + 2]
            if not fabs(one - (i == j)) < NEARLY:
                return False
    return (r[0] * (r[5] * r[10] - r[6] * r[9]) + r[1] * (r[6] * r[8] - r[4] * r[10]) +
            r[2] * (r[4] * r[9] - r[5] * r[8])) > 0.0


# ----------------------------------------------------------------------- for any module

def rotation(turn):
    cdef double v[3]
    cdef double m[9]
    copy(turn, 0, 3, v)
    by_turn(v[0], v[1], v[2], m)
    return matrix(m, 3, 3)


def turn_of(rotation):
    cdef double m[9]
    cdef double turn[3]
    copy(rotation, 3, 3, m)
    turn_from(m, turn)
    return matrix(turn, 1, 3)


def difference(wanted, pose):
    cdef double goal[12]
    cdef double at[12]
    cdef motion found
    copy(wanted, 3, 4, goal)
    copy(pose, 3, 4, at)
    found = between(goal, at)
    return matrix(found.way, 1, 6)


def is_rotation(matrix):
    cdef double m[9]
    cdef double r[12]
    cdef int i
    copy(matrix, 3, 3, m)
    for i in range(9):
        r[4 * (i // 3) + i % 3] = m[i]
    return bool(is_turn(r))


def fault_of_pose(pose):
    cdef double r[12]
    cdef int i
    copy(pose, 3, 4, r)
    for i in range(12):
        if not isfinite(r[i]):
            return "it has elements that are not finite"
    return "" if is_turn(r) else "its orientation is not a rotation"


cdef void quaternion(const double *r, double *x) noexcept nogil:
    """Write the quaternion x y z w of [R p], from its largest element (Shepperd 1978)."""
    cdef double t = r[0] + r[5] + r[10]
    cdef int i, j, k
    if t > 0.0:
        t = sqrt(t + 1.0)
        x[3] = 0.5 * t
        t = 0.5 / t
        x[0], x[1], x[2] = (r[9] - r[6]) * t, (r[2] - r[8]) * t, (r[4] - r[1]) * t
        return
    i = 1 if r[5] > r[0] else 0
    i = 2 if r[10] > r[5 * i] else i
    j, k = (i + 1) % 3, (i + 2) % 3
    t = sqrt(r[5 * i] - r[5 * j] - r[5 * k] + 1.0)
    x[i] = 0.5 * t
    t = 0.5 / t
    x[3] = (r[4 * k + j] - r[4 * j + k]) * t
    x[j] = (r[4 * j + i] + r[4 * i + j]) * t
    x[k] = (r[4 * k + i] + r[4 * i + k]) * t


cdef class FreeMotion:
    cdef double[::1] q, v

    def __init__(self, q, v):
        self.q, self.v = q, v
        if not self.q.shape[0] - BASE == self.v.shape[0] - RATES >= 1:
            raise ValueError("position and velocity are not those of one robot")

    def set(self, pose, velocity, q, qd):
        cdef Py_ssize_t n
        cdef double r[12]
        cdef double v[6]
        cdef int i
        copy(pose, 3, 4, r)
        copy(velocity, 0, 6, v)
        copy(q, 0, self.q.shape[0] - BASE, &self.q[BASE])
        copy(qd, 0, self.v.shape[0] - RATES, &self.v[RATES])
        quaternion(r, &self.q[3])
        for i in range(3):
            self.q[i] = r[4 * i + 3]
            self.v[i] = r[i] * v[0] + r[4 + i] * v[1] + r[8 + i] * v[2]
            self.v[3 + i] = r[i] * v[3] + r[4 + i] * v[4] + r[8 + i] * v[5]
        if not is_turn(r):
            return False
        for n in range(self.q.shape[0]):
            if not isfinite(self.q[n]):
                return False
        for n in range(self.v.shape[0]):
            if not isfinite(self.v[n]):
                return False
        return True


# ------------------------------------------------------------------- steps to the goals

cdef class FrameStep:
    cdef const double[:, :] wanted
    cdef const double[:] velocity
    cdef double[:, ::1] to
    cdef readonly object goal
    cdef readonly double speed, rate

    def __init__(self, wanted, velocity=None):
        self.wanted = wanted
        self.velocity = np.zeros(6) if velocity is None else velocity
        if (self.wanted.shape[0], self.wanted.shape[1], self.velocity.shape[0]) != (3, 4, 6):
            raise ValueError("a pose is [3, 4], and its velocity [6]")
        self.goal = np.eye(4)
        self.to = self.goal

    def aim(self, pose, double gain, double linear, double angular, double dt):
        cdef double at[12]
        cdef double m[9]
        cdef motion step
        cdef int i, j
        copy(pose, 3, 4, at)
        step = to_goal(self.wanted, at)
        for i in range(3):
            step.way[i] = gain * step.way[i] + self.velocity[i]
            step.turn[i] = gain * step.turn[i] + self.velocity[3 + i]
        self.speed = shortened(step.way, linear)
        self.rate = shortened(step.turn, angular)
        by_turn(dt * step.turn[0], dt * step.turn[1], dt * step.turn[2], m)
        for i in range(3):
            for j in range(3):
                self.to[i, j] = (m[3 * i] * at[j] + m[3 * i + 1] * at[4 + j] +
                                 m[3 * i + 2] * at[8 + j])
            self.to[i, 3] = at[4 * i + 3] + dt * step.way[i]

    def take(self):
        cdef int i, j
        for i in range(3):
            for j in range(4):
                self.to[i, j] = self.wanted[i, j]
                if not isfinite(self.to[i, j]):
                    return False
        return bool(is_turn(&self.to[0, 0]))

    def missing(self, pose, double length):
        cdef double at[12]
        cdef motion left
        cdef double most = 0.0
        cdef int i
        copy(pose, 3, 4, at)
        left = to_goal(self.to, at)
        for i in range(3):
            most = max(most, fabs(left.way[i]), length * fabs(left.turn[i]))
        return most


cdef class PlaceSteps:
    cdef const double[:, :] wanted
    cdef double[:, ::1] at, to
    cdef readonly object places, goals

    def __init__(self, wanted):
        self.wanted = wanted
        if self.wanted.shape[1] != 3:
            raise ValueError("places are [n, 3]")
        self.places, self.goals = np.zeros((2, self.wanted.shape[0], 3))
        self.at, self.to = self.places, self.goals

    def see(self, Py_ssize_t row, pose):
        cdef double at[12]
        cdef int i
        if not 0 <= row < self.at.shape[0]:
            raise ValueError(f"there is no place {row}")
        copy(pose, 3, 4, at)
        for i in range(3):
            self.at[row, i] = at[4 * i + 3]

    def aim(self, double gain, double limit, double dt):
        cdef double v[3]
        cdef double fastest = 0.0, square
        cdef Py_ssize_t n
        cdef int i
        for n in range(self.at.shape[0]):
            square = 0.0
            for i in range(3):
                v[i] = gain * (self.wanted[n, i] - self.at[n, i])
                square += v[i] * v[i]
            fastest = max(fastest, sqrt(square))
            shortened(v, limit)
            for i in range(3):
                self.to[n, i] = self.at[n, i] + dt * v[i]
        return fastest

    def farthest(self):
        cdef double most = 0.0
        cdef Py_ssize_t n, which = 0
        cdef int i
        for n in range(self.at.shape[0]):
            for i in range(3):
                if fabs(self.to[n, i] - self.at[n, i]) > most:
                    most, which = fabs(self.to[n, i] - self.at[n, i]), n
        return most, which


cdef double leaving(double way, double accel, double dt) noexcept nogil:
    """Return the speed of a step after which the way is still enough to stop.

    After it v^2 / (2 accel) of the way is left, so that later steps may be of any length.
    A joint beyond its limit, with no way left, comes back.
    """
    if way <= 0.0:
        return way / dt
    return 2.0 * way / (dt + sqrt(dt * dt + 2.0 * way / accel))


cdef class JointSteps:
    cdef double[::1] q, q_ref, qd_ref, step, to
    cdef const double[:] lower, upper, speed
    cdef readonly object room
    cdef readonly bint at_accel

    def __init__(self, q, q_ref, qd_ref, lower, upper, speed):
        self.q, self.q_ref, self.qd_ref = q, q_ref, qd_ref
        self.lower, self.upper, self.speed = lower, upper, speed
        if not 1 <= self.q.shape[0] == self.q_ref.shape[0] == self.qd_ref.shape[0]:
            raise ValueError("the references are not those of the joints")
        if not self.q.shape[0] == self.lower.shape[0] == self.upper.shape[0] == self.speed.shape[0]:
            raise ValueError("the limits are not those of the joints")
        self.step = np.zeros(RATES + self.q.shape[0])
        self.room = np.zeros(2 * self.q.shape[0])
        self.to = self.room
        self.at_accel = False

    def limit(self, double accel, double dt):
        cdef Py_ssize_t i, n = self.q.shape[0]
        cdef double low, high, below, above, slower, faster, most = accel * dt
        for i in range(n):
            below, above = self.lower[i] - self.q[i], self.upper[i] - self.q[i]
            if max(below, -above) > self.speed[i] * dt:
                return False
            slower, faster = self.qd_ref[i] - most, self.qd_ref[i] + most
            high = min(self.speed[i], faster, max(slower, leaving(above, accel, dt)))
            low = max(-self.speed[i], slower, min(faster, -leaving(-below, accel, dt)))
            if low > high:          # taken over with more than its largest speed
                low = high = slower if self.qd_ref[i] > 0.0 else faster
            above, below = max(above, 0.0), min(below, 0.0)
            self.to[i] = self.q[i] + min(max(dt * high, below), above)
            self.to[n + i] = -(self.q[i] + min(max(dt * low, below), above))
        return True

    def take(self, step, double dt):
        cdef Py_ssize_t i, n = self.q.shape[0]
        cdef double speed, way
        cdef bint held
        copy(step, 0, self.step.shape[0], &self.step[0])
        self.at_accel = False
        for i in range(n):
            speed = self.step[RATES + i] / dt
            self.q[i] += self.step[RATES + i]
            held = self.q[i] > self.to[i] - SMALL or self.q[i] < SMALL - self.to[n + i]
            if held and fabs(fabs(speed) - self.speed[i]) > 1e-3 * self.speed[i]:
                way = min(self.upper[i] - self.q[i], self.q[i] - self.lower[i])
                self.at_accel = self.at_accel or way > NEARLY
            self.q_ref[i], self.qd_ref[i] = self.q[i], speed
