"""A sensor with a linear law at a port of a device, such as a thermometer."""

from typing import TYPE_CHECKING, Annotated as A, Any, Literal

from pbonet import param
from pbonet.io.drivers import Mode, Wait, open_device
from pbonet.modules._linear_ports import Law, LinearInput
from pbonet.modules._over_device import HeardOf

if TYPE_CHECKING:
    from collections.abc import Sequence


class Place(Law, kw_only=True):
    """Where the sensor is connected, and its calibration."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    port: A[int, param("none", "port of the first element", ge=0)] = 0
    signed: A[bool, param("none", "whether the device's values have a sign")] = False
    wait: A[
        Literal["all", "none"],
        param("none", "none: what came since the last cycle, of a device on a line"),
    ] = "all"
    silent: A[float, param("s", "longest time without a value", gt=0)] = 1.0


class LinearSensor(LinearInput[Place], HeardOf[Place]):
    """y = scale * raw + offset, for each of the ports from PORT on.

    A thermometer or a light sensor at a converter, the inputs of a Modbus I/O block, a
    potentiometer: whatever a device with ports measures. The RMOD gives Y its variable,
    and with it the unit. In a cycle in which the device has nothing new, Y keeps its
    values and gets older; after SILENT seconds of that the task ends in ERROR, as it
    does when the device is lost. `on` opens it again.
    """

    def cycle(self, dt: float) -> None:
        super().cycle(dt)
        self._note(new=self._came)

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        k = self.params
        last = k.port + len(self.y) - 1
        wait = Wait(k.wait)
        return open_device(
            k.device, k.port, last, mode=Mode.READ, wait=wait, signed=k.signed
        )

    def _read(self, dt: float) -> "Sequence[int]":  # noqa: ARG002 - what is there now
        raw: list[int] = self._device.read()
        self._came = bool(raw)
        return raw

    def _longest(self) -> float:
        return self.params.silent
