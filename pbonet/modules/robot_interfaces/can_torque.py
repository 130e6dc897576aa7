"""Motor drives on a CAN bus that go by a torque: CANopen, CiA 402."""

from pbonet.modules._axes import Limit, TorqueAxes
from pbonet.modules._can_axes import CanAxes, Wires
from pbonet.modules._drive402 import Mode
from pbonet.modules._values import spread


class Torques(Wires, kw_only=True):
    """The drives, and their limits."""

    limit: Limit


class CanTorque(TorqueAxes[Torques], CanAxes[Torques]):
    """Drives get clip(t_ref, -limit, limit).

    Cyclic synchronous torque. The torque of an axis is that of its motor by the
    gear, without friction. How the drives are started, watched and stopped is as
    with `can_position`.
    """

    _mode = Mode.TORQUE

    def _take_limits(self) -> None:
        self._limit = spread(self.params.limit, len(self.q), "limit")
