"""The simulated twin of motor drives that go by a position."""

from typing import Annotated as A

from pbonet import param
from pbonet.modules._axes import Follow, PositionAxes, Speed
from pbonet.modules._simulated_axes import Body, SimulatedAxes
from pbonet.modules._values import spread


class Motors(Body, kw_only=True):
    """How the motors move."""

    lag: A[float, param("s", "time constant of the drive", gt=0)] = 0.01
    speed: Speed = (1.0,)
    follow: Follow = 20.0


class AxesPositionSim(PositionAxes[Motors], SimulatedAxes[Motors]):
    """r moves as in `can_position`, and lag * dq/dt = r - q.

    It has the ports of `can_position` and `dynamixel`, and opens no device: swap them.
    Where real drives stop quickly, it slows down by SLOW.
    """

    def _take_limits(self) -> None:
        self._speed = spread(self.params.speed, len(self.q), "speed")
        self._follow = self.params.follow

    def _move(self, dt: float) -> None:
        change = (dt / (self.params.lag + dt)) * (self._goal - self.q)
        self.q += change
        self.qd[:] = change / dt
