"""The simulated twin of motor drives that go by a speed."""

from typing import Annotated as A

from pbonet import param
from pbonet.modules._axes import Speed, SpeedAxes
from pbonet.modules._simulated_axes import Body, SimulatedAxes
from pbonet.modules._values import spread


class Motors(Body, kw_only=True):
    """How the motors move."""

    lag: A[float, param("s", "time constant of the drive", gt=0)] = 0.01
    speed: Speed = (1.0,)


class AxesSpeedSim(SpeedAxes[Motors], SimulatedAxes[Motors]):
    """lag * dqd/dt = clip(qd_ref, -speed, speed) - qd.

    It has the ports of `can_speed`, and opens no device: swap them.
    Where real drives stop quickly, it slows down by SLOW.
    """

    def _take_limits(self) -> None:
        self._speed = spread(self.params.speed, len(self.q), "speed")

    def _move(self, dt: float) -> None:
        self.qd += (dt / (self.params.lag + dt)) * (self._goal - self.qd)
        self.q += self.qd * dt
