"""An inertial measurement unit MPU-6050 on an I2C bus."""

from typing import Annotated as A, Any, Literal

from pbonet import param
from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, open_device
from pbonet.modules._mpu6050 import (
    BY_CLOCK_OF_GYRO,
    FILTERS,
    FORCES,
    INNER_HZ,
    IS_NEW,
    ITS_NAME,
    RATES,
    REGISTERS,
    SETUP,
    Mpu6050 as Chip,
    Ranges,
)
from pbonet.modules._over_device import HeardOf


class Place(Ranges, kw_only=True):
    """Where the chip is connected, and how it measures."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    filter: A[
        Literal["184", "94", "44", "21", "10", "5"],
        param("Hz", "bandwidth of the chip's low-pass filter"),
    ] = "44"
    silent: A[float, param("s", "longest time without a value", gt=0)] = 0.1


class Mpu6050(Chip[Place], HeardOf[Place]):
    """acc = range * g * raw / 2^15 - bias, gyr = range * raw / 2^15 - bias.

    The device is of the driver `i2c`, with `burst = true`, so that all values are of
    one measurement, and with these `registers`: 0x75, 0x6B, 0x19, 0x1A, 0x1B, 0x1C,
    and those from 0x3A to 0x48. The chip measures at the rate of the task, or the next
    higher one that it has. In a cycle without a new measurement ACC and GYR keep their
    values and get older; after SILENT seconds of that the task ends in ERROR, as it
    does when the chip does not answer. `imu_fusion` makes an orientation of them.
    """

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - what is there now
        status, *data = self._device.read()
        is_new = bool(status & IS_NEW)
        if is_new:
            self._show(bytes(data))
        self._note(new=is_new)

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        name = self.params.device
        first = len(SETUP) + 1
        device = open_device(name, first, len(REGISTERS) - 1, mode=Mode.READ)
        try:
            self._begin()
        except Exception:
            device.close()
            raise
        return device

    def _begin(self) -> None:
        """Set the chip up, if it is one."""
        name = self.params.device
        with open_device(name, 0, mode=Mode.READ) as port:
            (found,) = port.read()
        if found != ITS_NAME:
            raise DeviceError(
                "the chip is no MPU-6050",
                where=name,
                expected=f"{ITS_NAME:#x} in its register WHO_AM_I",
                got=f"{found:#x}",
                remedy="check the address, and the registers in agent.toml",
            )
        with open_device(name, 1, len(SETUP), mode=Mode.WRITE, safe=None) as setup:
            setup.write(self._setup())

    def _setup(self) -> tuple[int, ...]:
        """Return the values of the registers `SETUP`."""
        k = self.params
        divider = min(max(int(INNER_HZ / self.task.freq), 1), 256) - 1
        ranges = RATES[k.gyro_range] << 3, FORCES[k.acc_range] << 3
        return (BY_CLOCK_OF_GYRO, divider, FILTERS[k.filter], *ranges)

    def _longest(self) -> float:
        return self.params.silent
