"""Rigid-body mathematics of a serial arm with revolute joints, by pinocchio.

The arm is described as in Denavit and Hartenberg 1955 and Paul 1981: row i of the table
holds (theta, d, a, alpha), and frame i is placed in frame i-1 at Rz(theta + q) Tz(d)
Tx(a) Rx(alpha). Masses, centres of mass and inertias of link i are given in frame i.
Gravity points along -z of the base.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from .optional_packages import from_extra

if TYPE_CHECKING:
    from types import ModuleType

    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

    class _Model(Protocol):
        """The part of pinocchio's model that is used."""

        armature: Floats
        gravity: Any

        def createData(self) -> Any: ...  # noqa: ANN401, N802 - not ours to name
        def addJoint(self, *args: object) -> int: ...  # noqa: N802
        def appendBodyToJoint(self, *args: object) -> None: ...  # noqa: N802


GRAVITY = 9.81
"""m/s^2, as in the publications whose numbers are used."""


def pinocchio() -> ModuleType:
    """Return pinocchio.

    Raises:
        DeviceError: It is not installed.
    """
    with from_extra("robot", "rigid-body dynamics"):
        return import_module("pinocchio")


class Chain:
    """A serial arm: its gravity torques, mass matrix, velocity torques and energy.

    Every result is a view of memory that the next call of the same method writes
    again; copy what must be kept.

    Args:
        dh: Rows of theta (rad), d (m), a (m), alpha (rad); one for each joint.
        mass: kg, one for each link.
        com: Centre of mass of each link in its own frame, m; n rows of three.
        inertia: Of each link about its centre of mass, kg*m^2: n rows of the three
            diagonal terms, or n matrices. Zero when only gravity is asked for.
        rotor: Inertia of each motor as felt at its joint, kg*m^2.
    """

    def __init__(
        self,
        dh: ArrayLike,
        mass: ArrayLike,
        com: ArrayLike,
        inertia: ArrayLike | None = None,
        rotor: ArrayLike | None = None,
    ) -> None:
        self._pin = pinocchio()
        rows = np.asarray(dh, dtype=np.float64).reshape(-1, 4)
        self.n = len(rows)
        masses = np.asarray(mass, dtype=np.float64).reshape(self.n)
        coms = np.asarray(com, dtype=np.float64).reshape(self.n, 3)
        self._model = self._build(rows, masses, coms, _matrices(inertia, self.n))
        if rotor is not None:
            self._model.armature = np.asarray(rotor, dtype=np.float64).reshape(self.n)
        self._data = self._model.createData()

    def gravity(self, q: Floats) -> Floats:
        """Return the torques (N*m) that hold the arm still at `q` (rad)."""
        torque: Floats = self._pin.computeGeneralizedGravity(self._model, self._data, q)
        return torque

    def mass_matrix(self, q: Floats) -> Floats:
        """Return the mass matrix (kg*m^2), motors included, at `q` (rad)."""
        mass: Floats = self._pin.crba(self._model, self._data, q)
        return mass

    def bias(self, q: Floats, qd: Floats) -> Floats:
        """Return gravity, centrifugal and Coriolis torques (N*m) at `q`, `qd`."""
        torque: Floats = self._pin.nonLinearEffects(self._model, self._data, q, qd)
        return torque

    def energy(self, q: Floats, qd: Floats) -> float:
        """Return kinetic and potential energy (J); the motors' kinetic one too."""
        mass = self.mass_matrix(q)
        potential = self._pin.computePotentialEnergy(self._model, self._data, q)
        return float(0.5 * qd @ mass @ qd + potential)

    def position(self, q: Floats) -> Floats:
        """Return the last frame's origin in the base (m) at `q` (rad)."""
        self._pin.forwardKinematics(self._model, self._data, q)
        place: Floats = (self._data.oMi[self.n] * self._tip).translation
        return place

    def _build(self, dh: Floats, mass: Floats, com: Floats, inertia: Floats) -> _Model:
        pin = self._pin
        model: _Model = pin.Model()
        model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
        at, parent = pin.SE3.Identity(), 0
        for k, (theta, d, a, alpha) in enumerate(dh):
            turned = at * pin.SE3(_rz(theta), np.zeros(3))
            parent = model.addJoint(parent, pin.JointModelRZ(), turned, f"joint{k + 1}")
            at = pin.SE3(_rx(alpha), np.array([a, 0.0, d]))
            body = pin.Inertia(mass[k], com[k], inertia[k])
            model.appendBodyToJoint(parent, body, at)
        self._tip = at
        return model


def _matrices(inertia: ArrayLike | None, n: int) -> Floats:
    if inertia is None:
        return np.zeros((n, 3, 3))
    given = np.asarray(inertia, dtype=np.float64)
    if given.shape == (n, 3):
        return given[:, :, None] * np.eye(3)
    return given.reshape(n, 3, 3)


def _rz(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rx(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
