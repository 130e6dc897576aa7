"""The simulated twin of an actuator with a linear law."""

from typing import Annotated as A

from pbonet import Vector, param
from pbonet.modules._linear_ports import Law, LinearOutput, port_range
from pbonet.modules._values import PerElement, spread


class Outlet(Law, kw_only=True):
    """The calibration, the safe values, and how fast the actuator follows."""

    safe: A[PerElement, param("none", "values that are safe, in the unit of U")]
    bits: A[int, param("none", "bits of a port of the device", ge=1, le=32)] = 16
    signed: A[bool, param("none", "whether the device's values have a sign")] = False
    lag: A[float, param("s", "time constant of the actuator; 0 for none", ge=0)] = 0.0


class LinearActuatorSim(LinearOutput[Outlet]):
    """lag * dy/dt = u - y, with u in steps of SCALE and within what BITS can have.

    It has the ports and the law of `linear_actuator`, and opens no device: swap the
    two.
    """

    def init(self) -> None:
        super().init()
        k = self.params
        self._low, self._high = port_range(k.bits, signed=k.signed)

    def off(self) -> None:
        if not self.task.handover:
            self._give(self._safe, 0.0)

    def _give(self, u: Vector, dt: float) -> None:
        goal = self._raw(u, self._low, self._high) * self._scale + self._offset
        lag = self.params.lag
        share = dt / (lag + dt) if lag and dt else 1.0
        self.y += share * (goal - self.y)

    def _safe_values(self) -> Vector:
        return spread(self.params.safe, len(self.y), "safe")
