"""Motor drives on a CAN bus that go by a speed: CANopen, CiA 402."""

from pbonet.modules._axes import Speed, SpeedAxes
from pbonet.modules._can_axes import CanAxes, Wires
from pbonet.modules._drive402 import Mode
from pbonet.modules._values import spread


class Speeds(Wires, kw_only=True):
    """The drives, and their limits."""

    speed: Speed = (1.0,)


class CanSpeed(SpeedAxes[Speeds], CanAxes[Speeds]):
    """Drives go at clip(qd_ref, -speed, speed).

    Cyclic synchronous velocity. How the drives are started, watched and stopped is
    as with `can_position`.
    """

    _mode = Mode.SPEED

    def _take_limits(self) -> None:
        self._speed = spread(self.params.speed, len(self.q), "speed")
