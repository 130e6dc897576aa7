"""PID control of any variable, one independent loop per element."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._values import PerElement, spread
from pbonet.modules.controllers._takeover import Takeover

GAINS = ("kp", "ki", "kd", "weight", "lower", "upper")


class Gains(Params):
    """The gains, one for each element or one for all; in units of Z_CMD and of Z."""

    kp: A[PerElement, param("none", "proportional gain")]
    lower: A[PerElement, param("none", "smallest Z_CMD")]
    upper: A[PerElement, param("none", "largest Z_CMD")]
    ki: A[PerElement, param("1/s", "integral gain")] = (0.0,)
    kd: A[PerElement, param("s", "derivative gain")] = (0.0,)
    weight: A[
        PerElement, param("none", "share of Z_REF in the proportional part", ge=0, le=1)
    ] = (1.0,)
    tau: A[float, param("s", "time constant of the derivative's filter", ge=0)] = 0.01
    fade: A[float, param("s", "time until Z_CMD is what the law says", gt=0)] = 0.1


class Pid(PortBasedObject[Gains], module_class="controller"):
    """z_cmd = kp (weight z_ref - z) + integral(ki (z_ref - z)) - kd dz/dt.

    The derivative is that of the measurement, so steps of the reference do not kick,
    through a first-order lag of TAU. Z_CMD stays within LOWER and UPPER. While an
    element is at a limit, its integral does not grow in that direction (conditional
    integration; Astrom and Hagglund 2006, section 3.5). When the module is turned on,
    the integral begins so that Z_CMD goes on from where it stands; where there is no
    integral gain, the distance fades. Where the velocity is measured, `joint_pid` damps
    by that.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z_ref: A[Vector, InVar("Z_REF", "ndof", "any", "reference")]
    z: A[Vector, InVar("Z_MEZ", "ndof", "any", "measured value")]
    z_cmd: A[Vector, OutVar("Z_CMD", "ndof", "any", "command")]

    def init(self) -> None:
        self._integral = np.zeros(self.ndof)
        self._rate = np.zeros(self.ndof)
        self._takeover = Takeover(self.z_cmd)
        self._take_gains()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_gains()

    def on(self) -> None:
        self._before = self.z.copy()
        self._rate[:] = 0.0
        self._begins = True
        self._takeover.begin()

    def cycle(self, dt: float) -> None:
        self._rate *= self.params.tau
        self._rate += self.z - self._before
        self._rate /= self.params.tau + dt
        self._before[:] = self.z
        law = self._kp * (self._weight * self.z_ref - self.z) - self._kd * self._rate
        if self._begins:
            self._begins = False
            self._integral[:] = np.where(self._ki != 0.0, self.z_cmd - law, 0.0)
        law += self._integral
        self._integrate(law, dt)
        self._takeover.apply(law, dt, self.params.fade)

    def _integrate(self, law: Vector, dt: float) -> None:
        """Let the integral grow, but not outward where the law is at a limit."""
        step = self._ki * (self.z_ref - self.z) * dt
        outward = (law >= self._upper) & (step > 0.0)
        outward |= (law <= self._lower) & (step < 0.0)
        step[outward] = 0.0
        self._integral += step

    def _take_gains(self) -> None:
        k, n = self.params, self.ndof
        found = {name: spread(getattr(k, name), n, name) for name in GAINS}
        if (found["lower"] >= found["upper"]).any():
            raise ParameterError(
                "the limits leave no room",
                expected="LOWER below UPPER",
                got=f"LOWER {k.lower}, UPPER {k.upper}",
                remedy="exchange the two",
            )
        self._kp, self._ki, self._kd = found["kp"], found["ki"], found["kd"]
        self._weight = found["weight"]
        self._lower, self._upper = found["lower"], found["upper"]
        self._takeover.bound(self._lower, self._upper)
