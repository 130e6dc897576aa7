"""The simulated twin of motor drives that go by a torque."""

from typing import Annotated as A

from pbonet import param
from pbonet.modules._axes import Limit, TorqueAxes
from pbonet.modules._simulated_axes import Body, SimulatedAxes
from pbonet.modules._values import PerElement, spread


class Motors(Body, kw_only=True):
    """How the motors move."""

    inertia: A[PerElement, param("kg*m^2", "of the axis", gt=0)]
    damping: A[PerElement, param("N*m*s/rad", "friction", ge=0)] = (0.0,)
    limit: Limit


class AxesTorqueSim(TorqueAxes[Motors], SimulatedAxes[Motors]):
    """inertia * dqd/dt = clip(t_ref, -limit, limit) - damping * qd.

    It has the ports of `can_torque`, and opens no device: swap them.
    Where real drives stop quickly, it slows down by SLOW.
    """

    def _take_limits(self) -> None:
        self._limit = spread(self.params.limit, len(self.q), "limit")
        self._inertia = spread(self.params.inertia, len(self.q), "inertia")
        self._damping = spread(self.params.damping, len(self.q), "damping")

    def _move(self, dt: float) -> None:
        friction = self._damping * self.qd
        self.qd += (self._goal - friction) / self._inertia * dt
        self.q += self.qd * dt
        self.tau[:] = self._goal
