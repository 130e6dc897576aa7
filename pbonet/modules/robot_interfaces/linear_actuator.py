"""An actuator with a linear law at a port of a device, such as a relay or a valve."""

from typing import Annotated as A, Any, Literal

import numpy as np

from pbonet import Vector, param
from pbonet.io.drivers import Mode, Wait, open_device
from pbonet.modules._linear_ports import Law, LinearOutput, port_range
from pbonet.modules._over_device import OverDevice
from pbonet.modules._values import PerElement, spread


class Outlet(Law, kw_only=True):
    """Where the actuator is connected, its calibration and its safe values."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    safe: A[PerElement, param("none", "values that are safe, in the unit of U")]
    port: A[int, param("none", "port of the first element", ge=0)] = 0
    signed: A[bool, param("none", "whether the device's values have a sign")] = False
    wait: A[
        Literal["all", "none"],
        param("none", "none: the newest values, as soon as a device on a line is free"),
    ] = "all"


class LinearActuator(LinearOutput[Outlet], OverDevice[Outlet]):
    """raw = round((u - offset) / scale) to each port from PORT on; y is what that is.

    Relays and analogue outputs of a Modbus I/O block, a digital to analogue converter:
    whatever a device with ports moves or switches. SAFE is written while U is too old
    or the configuration is illegal, when the task is turned off, also for a twin that
    takes over, and when it fails, is killed or dies.
    """

    def off(self) -> None:
        self._show(self._raw(self._safe, self._low, self._high))

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        k = self.params
        safe = self._raw(self._safe, -np.inf, np.inf)
        device = open_device(
            k.device,
            k.port,
            k.port + len(self.y) - 1,
            mode=Mode.WRITE,
            wait=Wait(k.wait),
            signed=k.signed,
            safe=safe.astype(int).tolist(),
        )
        bits: int = min(device.status("PORTSIZE", k.port), 32)
        self._low, self._high = port_range(bits, signed=k.signed)
        return device

    def _give(self, u: Vector, dt: float) -> None:  # noqa: ARG002 - at once
        raw = self._raw(u, self._low, self._high)
        self._device.write(raw.astype(int).tolist())
        self._show(raw)

    def _show(self, raw: Vector) -> None:
        """Say which values the device's whole numbers stand for."""
        np.multiply(raw, self._scale, out=self.y)
        self.y += self._offset

    def _safe_values(self) -> Vector:
        return spread(self.params.safe, len(self.y), "safe")
