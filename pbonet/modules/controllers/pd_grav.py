"""Joint-space PD control with gravity compensation."""

from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, spread
from pbonet.modules.controllers._approach import Approach
from pbonet.modules.controllers._takeover import Takeover


class Gains(Params):
    """The gains, one for each joint or one for all."""

    kp: A[PerElement, param("N*m/rad", "stiffness", ge=0)]
    kd: A[PerElement, param("N*m*s/rad", "damping", ge=0)]
    limit: A[PerElement, param("N*m", "largest torque", gt=0)]
    speed: A[
        PerElement, param("rad/s", "how fast it begins to go to a Q_REF far away", gt=0)
    ] = (0.5,)
    fade: A[float, param("s", "time until T_REF is what the law says", gt=0)] = 0.1


class PdGrav(PortBasedObject[Gains], module_class="controller"):
    """tau = kp (q_ref - q) - kd qd + t_grav, within +-limit.

    It brings any arm to a reference that stands still, without a model of its inertia
    (Takegaki and Arimoto 1981). T_GRAV comes from `grav_comp` or `gravity`. When the
    module is turned on it goes on from the T_REF that is there, and the distance fades.
    Without a predecessor the reference begins where the arm is, and goes to Q_REF at
    SPEED: the arm may have been moved by hand.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q_ref: A[Vector, InVar("Q_REF", "ndof", "rad", "reference position")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    t_grav: A[Vector, InVar("T_GRAV", "ndof", "N*m", "torque that balances gravity")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "commanded torque")]

    def init(self) -> None:
        self._takeover = Takeover(self.tau)
        self._approach = Approach(self.ndof)
        self._take_gains()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_gains()

    def on(self) -> None:
        self._takeover.begin()
        self._approach.begin(self.task, self.q_ref, self.q)

    def cycle(self, dt: float) -> None:
        way = self._approach
        reference = way.of(self.q_ref, self._speed, dt) if way.goes_on else self.q_ref
        law = self._kp * (reference - self.q) - self._kd * self.qd + self.t_grav
        self._takeover.apply(law, dt, self.params.fade)

    def _take_gains(self) -> None:
        k, n = self.params, self.ndof
        self._kp, self._kd = spread(k.kp, n, "kp"), spread(k.kd, n, "kd")
        self._speed = spread(k.speed, n, "speed")
        limit = spread(k.limit, n, "limit")
        self._takeover.bound(-limit, limit)
