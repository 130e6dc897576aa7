"""Motor drives on a CAN bus that go by a position: CANopen, CiA 402."""

from pbonet.modules._axes import Follow, PositionAxes, Speed
from pbonet.modules._can_axes import CanAxes, Wires
from pbonet.modules._drive402 import Mode
from pbonet.modules._values import spread


class Positions(Wires, kw_only=True):
    """The drives, and their limits."""

    speed: Speed = (1.0,)
    follow: Follow = 20.0


class CanPosition(PositionAxes[Positions], CanAxes[Positions]):
    """r moves by clip(follow * (q_ref - r), -speed, speed) * dt; drives go to r.

    Cyclic synchronous position: r begins where the axes are, so that nothing that
    is written to Q_REF makes them jump. When the task is turned on it sets the
    drives' objects, starts the drives and enables them step by step; READY says
    when all of them follow. While the reference is too old or the configuration is
    illegal, when the task is turned off, also for a twin that takes over, and when
    it fails or is killed, they stop quickly.

    Each side sees after BEAT that the other one is lost: the drives then stop by
    themselves (objects 1016h and 6007h), and the task ends in ERROR. So it does for
    a fault of a drive, which `clear` allows the next `on` to reset. A drive that
    something else has disabled is not enabled again. All drives of one task are on
    one bus; it has the identities 180h, 200h, 280h, 580h, 600h and 700h of their
    nodes.
    """

    _mode = Mode.POSITION

    def _take_limits(self) -> None:
        self._speed = spread(self.params.speed, len(self.q), "speed")
        self._follow = self.params.follow
