"""Axes that are driven by position, speed or torque: ports, and how a goal is followed.

A module adds what moves: drives on a bus, or a simulation of them.
"""

from typing import Annotated as A, TypeVar

import numpy as np

from pbonet import InVar, OutConst, OutVar, Params, PortBasedObject, Vector, param

from ._values import PerElement, keep, spread


class Joints(Params, kw_only=True):
    """The axes, one value for each or one for all."""

    gear: A[
        PerElement, param("none", "turns of the motor for one of Q; minus reverses")
    ] = (1.0,)


Speed = A[PerElement, param("rad/s", "largest speed", gt=0)]
Follow = A[float, param("1/s", "gain with which Q_REF is followed", gt=0)]
Limit = A[PerElement, param("N*m", "largest torque", gt=0)]
J = TypeVar("J", bound=Joints)


class Axes(PortBasedObject[J], abstract=True, module_class="robot interface"):
    """The ports of all. `cycle` and `stable` are those of the part that moves them."""

    ndof: A[int, OutConst("NDOF", "1", "none", "number of axes")]
    gears: A[
        Vector,
        OutConst("GEAR", "ndof", "none", "turns of the motor for one of the axis"),
    ]
    q: A[Vector, OutVar("Q_MEZ", "ndof", "rad", "measured position", new=True)]
    qd: A[Vector, OutVar("Q^_MEZ", "ndof", "rad/s", "measured speed", new=True)]
    tau: A[Vector, OutVar("T_MEZ", "ndof", "N*m", "measured torque", new=True)]
    ready: A[
        int, OutVar("READY", "1", "none", "1 while all axes follow, else 0", new=True)
    ]

    def init(self) -> None:
        self.ndof = n = len(self.q)
        self.gears[:] = self._gear = spread(self.params.gear, n, "gear")
        self._goal: Vector = np.zeros(n)
        self._take_limits()
        super().init()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, self._fixed)
        self._take_limits()

    _fixed = frozenset({"gear"})
    """Parameters that are read when the task is created."""

    def _wish(self, dt: float) -> None:
        """Bring `_goal` to what the module reads."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _rest(self) -> None:
        """Make `_goal` what keeps the axes where they are."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _read_goal(self) -> Vector:
        """Return what the module reads."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _take_limits(self) -> None:
        """Take the limits of the parameters."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _is_sound(self) -> bool:
        """Return whether the goal is finite; else the task fails."""
        if np.isfinite(self._read_goal()).all():
            return True
        self.task.fail("the reference is not finite; the drives stop")
        return False


class PositionAxes(Axes[J], abstract=True):
    """Axes that go to a position."""

    _speed: Vector
    _follow: float
    q_ref: A[
        Vector,
        InVar(
            "Q_REF", "ndof", "rad", "reference position", max_age=0.1, stale="stable"
        ),
    ]

    def _wish(self, dt: float) -> None:
        speed = self._follow * (self.q_ref - self._goal)
        self._goal += speed.clip(-self._speed, self._speed) * dt

    def _rest(self) -> None:
        self._goal[:] = self.q

    def _read_goal(self) -> Vector:
        return self.q_ref


class SpeedAxes(Axes[J], abstract=True):
    """Axes that go at a speed."""

    _speed: Vector
    qd_ref: A[
        Vector,
        InVar(
            "Q^_REF", "ndof", "rad/s", "reference speed", max_age=0.1, stale="stable"
        ),
    ]

    def _wish(self, dt: float) -> None:  # noqa: ARG002 - at once
        self.qd_ref.clip(-self._speed, self._speed, out=self._goal)

    def _rest(self) -> None:
        self._goal[:] = 0.0

    def _read_goal(self) -> Vector:
        return self.qd_ref


class TorqueAxes(Axes[J], abstract=True):
    """Axes that get a torque."""

    _limit: Vector
    t_ref: A[
        Vector,
        InVar("T_REF", "ndof", "N*m", "torque", max_age=0.05, stale="stable"),
    ]

    def _wish(self, dt: float) -> None:  # noqa: ARG002 - at once
        self.t_ref.clip(-self._limit, self._limit, out=self._goal)

    def _rest(self) -> None:
        self._goal[:] = 0.0

    def _read_goal(self) -> Vector:
        return self.t_ref
