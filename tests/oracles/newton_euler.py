"""The torques of an arm by a recursive Newton-Euler method written by hand.

It is the textbook recursion (Luh, Walker and Paul 1980) over the frames of the
Denavit-Hartenberg table, in plain numpy. It shares nothing with the code under test but
the table of numbers: no pinocchio, no spatial algebra.
"""

from __future__ import annotations

import numpy as np

G = 9.81


def newton_euler(arm, q, qd, qdd, g=G):
    """Return the joint torques (N*m), motors' inertia left out."""
    n = len(q)
    z = np.array([0.0, 0.0, 1.0])
    rotation, offset = [], []  # frame i in frame i-1; the step in frame i
    for k in range(n):
        theta, d, a, alpha = arm.dh[k]
        ct, st = np.cos(theta + q[k]), np.sin(theta + q[k])
        ca, sa = np.cos(alpha), np.sin(alpha)
        rotation.append(
            np.array([[ct, -st * ca, st * sa], [st, ct * ca, -ct * sa], [0, sa, ca]])
        )
        offset.append(np.array([a, d * sa, d * ca]))

    w, dw, dv = np.zeros(3), np.zeros(3), np.array([0.0, 0.0, g])
    forces, moments = [], []
    for k in range(n):
        to_here = rotation[k].T
        dw = to_here @ (dw + z * qdd[k] + np.cross(w, z * qd[k]))
        w = to_here @ (w + z * qd[k])
        step = offset[k]
        dv = np.cross(dw, step) + np.cross(w, np.cross(w, step)) + to_here @ dv
        com = arm.com[k]
        dvc = np.cross(dw, com) + np.cross(w, np.cross(w, com)) + dv
        inertia = np.diag(arm.inertia[k])
        forces.append(arm.mass[k] * dvc)
        moments.append(inertia @ dw + np.cross(w, inertia @ w))

    torque = np.zeros(n)
    f, m = np.zeros(3), np.zeros(3)  # upon link k+1, in frame k
    for k in reversed(range(n)):
        step, com = offset[k], arm.com[k]
        m = m + np.cross(step, f) + np.cross(step + com, forces[k]) + moments[k]
        f = f + forces[k]
        f, m = rotation[k] @ f, rotation[k] @ m  # about the origin of frame k-1, in it
        torque[k] = m @ z
    return torque
