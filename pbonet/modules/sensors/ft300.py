"""A Robotiq FT 300 force torque sensor on a serial line."""

from typing import TYPE_CHECKING, Annotated as A, Any

from pbonet import (
    OutVar,
    Params,
    Recovery,
    TimingFailure,
    Vector,
    param,
)
from pbonet.io.drivers import Mode, Wait, open_device
from pbonet.modules._ft300_frames import BEGIN, END, FORCE, TORQUE, Frames
from pbonet.modules._over_device import OverDevice
from pbonet.modules._values import keep

if TYPE_CHECKING:
    from collections.abc import Sequence

MOST = 1024
"""Bytes taken at once. As many are more than half a second of frames, whose age is not
known: they are dropped."""


class Place(Params):
    """Where the sensor is connected."""

    device: A[str, param("none", "device of agent.toml", device=True)]
    silent: A[float, param("s", "longest time without a frame", gt=0)] = 0.1


class Ft300(OverDevice[Place], module_class="sensor"):
    """f = 0.01 N * raw and 0.001 N*m * raw, in each cycle of the newest frame.

    Its task is synchronous: a frame of the sensor begins a cycle, whatever the rate of
    the controller that reads F_RAW. The device is of the driver `serial`, with
    `baud = 19200`, or of `tcp` behind a converter. Damaged bytes are passed over until
    a frame fits its checksum. When more frames wait than the task can take, the newest
    counts. After SILENT seconds without a frame the task ends in ERROR, as it does
    when the line is lost. `wrench_comp` takes the sensor's zero and the tool's weight.
    """

    f: A[Vector, OutVar("F_RAW", "6", "mixed", "wrench, N and N*m", new=True)]

    def init(self) -> None:
        self._frames = Frames()
        super().init()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"device"})

    def on(self) -> None:
        super().on()
        self._found: Sequence[int] | None = None
        self._waits, self._failures = False, 0
        self._device.write(BEGIN)

    def sync(self) -> None:
        """Wait for a frame."""
        self._waits = True
        while self._found is None:
            data = self._device.read(MOST)
            if len(data) < MOST:
                self._found = self._frames.newest(data)
            else:
                self._frames.forget()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self._waits, self._failures = False, 0
        if self._found is not None:
            self.f[:] = self._found
            self.f[:3] *= FORCE
            self.f[3:] *= TORQUE
            self._found = None

    def timing_failure(self, kind: TimingFailure) -> Recovery:
        """Count how long the sensor is silent: each failure is two periods more."""
        if kind is TimingFailure.DEADLINE and self._waits:
            self._failures += 1
            silent = self.params.silent
            if self._failures * 2.0 * self.task.period >= silent:
                self.task.fail(f"the sensor has sent no frame for {silent:g} s")
        return Recovery.CONTINUE

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        return open_device(self.params.device, mode=Mode.RW, wait=Wait.ONE, safe=END)
