"""A serial line: class SIO, driver ``serial``."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, NamedTuple

from pbonet.errors import DeviceError
from pbonet.io import SerialPort

from .device import Settings
from .device_classes import StreamDevice
from .modes import Mode
from .stream_waits import read_all, write_all


class SerialSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a serial line."""

    baud: int = 9600
    bits: Literal[7, 8] = 8
    parity: Literal["N", "E", "O"] = "N"
    stop: Literal[1, 2] = 1
    rtscts: bool = False


class SioParam(NamedTuple):
    """Properties of a serial line: what ``SIO_GET`` returns and ``SIO_SET`` takes."""

    baud: int
    bits: int
    stop: int
    parity: str


class SerialDevice(StreamDevice):
    """A serial line; its address is the device file."""

    settings_type: ClassVar[type[Settings]] = SerialSettings
    packages: ClassVar[tuple[str, ...]] = ("serial",)

    def connect(self) -> None:
        """Open the line; see `Device.connect`."""
        k = self.settings
        self._param = SioParam(k.baud, k.bits, k.stop, k.parity)
        self._open_line()

    def _open_line(self) -> None:
        p = self._param
        self._line = SerialPort(
            self.entry.address,
            p.baud,
            bits=p.bits,
            parity=p.parity,  # type: ignore[arg-type]
            stop=p.stop,
            rtscts=self.settings.rtscts,
        )
        self._line.open()
        self._held = bytearray()

    def disconnect(self) -> None:
        """Close the line."""
        self._line.close()

    def read(self, count: int) -> bytes:
        """Return bytes that have arrived; see `StreamDevice.read`."""
        self.require(Mode.READ)
        data: bytes = self.ask(self._read, count, default=b"")
        return data

    def _read(self, count: int) -> bytes:
        line = self._line
        return read_all(line.fileno(), line.read, count, self.opening.wait, self._held)

    def write(self, data: bytes) -> int:
        """Hand bytes over; see `StreamDevice.write`."""
        self.require(Mode.WRITE)
        done: int = self.ask(self._write, data, default=len(data))
        return done

    def _write(self, data: bytes) -> int:
        line, wait = self._line, self.opening.wait
        return write_all(line.fileno(), line.write, data, wait, self.patience)

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the line: ``SIO_GET`` gives a `SioParam`."""
        if command == "SIO_GET":
            return SioParam(*self.ask(lambda: tuple(self._param), default=None))
        return super().status(command, port)

    def control(self, command: str, value: Any) -> None:  # noqa: ANN401
        """Change the line: ``SIO_SET`` takes a `SioParam`."""
        if command != "SIO_SET":
            super().control(command, value)
        self.ask(self._set, SioParam(*value), default=None)

    def _set(self, param: SioParam) -> None:
        before, self._param = self._param, param
        self._line.close()
        try:
            self._open_line()
        except DeviceError:
            self._param = before
            self._open_line()
            raise
