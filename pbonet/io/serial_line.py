"""A serial line that never blocks.

pyserial opens and configures the line, because it knows the differences between
drivers. Bytes are then moved by plain system calls on the descriptor, for two
reasons: pyserial's own `write` spins while the output buffer is full, and its `close`
may wait half a minute for output that is not read.
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import struct
import termios
from contextlib import suppress
from importlib import import_module
from time import monotonic, sleep
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    Literal,
    Protocol,
    Self,
    TypedDict,
    TypeVar,
    Unpack,
    cast,
)

from pbonet.errors import DeviceError
from pbonet.outside import Outside

from .policy import require_devices

if TYPE_CHECKING:
    from collections.abc import Callable

Parity = Literal["N", "E", "O"]
T = TypeVar("T")


class LineSettings(TypedDict, total=False):
    """How a serial line is set, beside its speed."""

    bits: int
    """Data bits, 7 or 8."""
    parity: Parity
    stop: int
    """Stop bits, 1 or 2."""
    rtscts: bool
    """Whether the line's handshake wires stop the flow of data."""


_LAST: Final = 0.2
"""Seconds in which a line that is closed sends what it was given."""
_AGAIN: Final = 0.001
"""Seconds after which that is asked again."""


class _Port(Protocol):
    """The part of pyserial's port that is used here."""

    fd: int

    def close(self) -> None: ...

    def reset_output_buffer(self) -> None: ...


class SerialPort:
    """A serial line of the machine, non-blocking; nothing of it is recorded.

    Args:
        path: The line's device file, such as ``/dev/ttyUSB0``.
        baud: Bits a second.
        settings: The others; by default 8 data bits, no parity and 1 stop bit.
    """

    def __init__(
        self, path: str, baud: int = 9600, **settings: Unpack[LineSettings]
    ) -> None:
        self.path = path
        self._settings: dict[str, Any] = {
            "baudrate": baud,
            "bytesize": settings.get("bits", 8),
            "parity": settings.get("parity", "N"),
            "stopbits": settings.get("stop", 1),
            "rtscts": settings.get("rtscts", False),
            "timeout": 0,
        }
        self._port: _Port | None = None

    def fileno(self) -> int:
        """Return the descriptor.

        Raises:
            OSError: The line is closed.
        """
        if self._port is None:
            raise OSError(errno.EBADF, "the line is closed")
        return self._port.fd

    def open(self) -> None:
        """Open and configure the line.

        Raises:
            DeviceError: It is missing, not a serial line, forbidden, or taken; or
                pyserial is not installed.
        """
        try:
            serial = import_module("serial")
        except ImportError:
            raise DeviceError(
                "serial lines need pyserial, which is not installed",
                where=self.path,
                remedy="pip install 'pbonet[devices]'",
            ) from None
        try:
            port = serial.Serial(self.path, exclusive=True, **self._settings)
        except (OSError, ValueError, termios.error) as error:
            raise self._refused(error) from None
        self._port = cast("_Port", port)
        try:
            _distinguish_hangup(self._port.fd)
        except (OSError, termios.error) as error:
            self.close()
            raise self._refused(error) from None

    def read(self, limit: int) -> bytes:
        """Return the bytes that have arrived, at most `limit`; never waits.

        Raises:
            OSError: The device is gone.
        """
        try:
            data = os.read(self.fileno(), limit)
        except BlockingIOError:
            return b""
        if not data and limit:
            raise OSError(errno.EIO, "the line hung up")
        return data

    def write(self, data: bytes) -> int:
        """Hand over what the line takes now; return how many bytes.

        Raises:
            OSError: The device is gone.
        """
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0

    def wait(self, seconds: float) -> None:
        """Wait until bytes have arrived, at most so long."""
        select.select([self.fileno()], [], [], seconds)

    def discard(self) -> None:
        """Forget the bytes that have arrived and were not read.

        Raises:
            OSError: The device is gone.
        """
        try:
            termios.tcflush(self.fileno(), termios.TCIFLUSH)
        except termios.error as error:
            raise OSError(*error.args) from None

    def close(self) -> None:
        """Close the line, and drop output that is not sent within `_LAST` seconds.

        Closing twice is allowed.
        """
        port, self._port = self._port, None
        if port is None:
            return
        with suppress(OSError, termios.error):
            if not _is_sent(port.fd):
                port.reset_output_buffer()
        with suppress(OSError, termios.error):
            port.close()

    def _refused(self, error: Exception) -> DeviceError:
        number = getattr(error, "errno", None)
        remedies = {
            errno.ENOENT: "check cable and name; `ls /dev/tty*` lists the devices",
            errno.EACCES: "add the user to the group that owns it, often `dialout`",
            errno.EAGAIN: "another program has it open; end that program",
        }
        return DeviceError(
            "the serial line cannot be opened",
            where=self.path,
            got=os.strerror(number) if number else str(error),
            remedy=remedies.get(number or 0, "give the device file of a serial line"),
        )


class SerialLine:
    """One serial line, non-blocking in both directions.

    Args:
        path: The line's device file, such as ``/dev/ttyUSB0``.
        baud: Bits a second.
        settings: The others; by default 8 data bits, no parity and 1 stop bit.

    After an error the line is closed, and may be opened again.
    """

    def __init__(
        self, path: str, baud: int = 9600, **settings: Unpack[LineSettings]
    ) -> None:
        self.path = path
        self._port = SerialPort(path, baud, **settings)
        self._outside = Outside(f"serial line {path}")
        self._opened = False

    @property
    def is_open(self) -> bool:
        """Whether bytes can be moved."""
        return self._opened

    def open(self) -> None:
        """Open and configure the line; return at once if it is open already.

        Raises:
            DeviceError: The line is missing, not a serial line, forbidden, or taken;
                or pyserial is not installed.
        """
        if self._opened:
            return
        require_devices(self.path)
        self._outside.ask(self._port.open, default=None)
        self._opened = True

    def read_available(self, limit: int = 256) -> bytes:
        """Return the bytes that have arrived, at most `limit`; never waits.

        Raises:
            DeviceError: The line is not open, or the device is gone.
        """
        return self._ask(self._port.read, limit, default=b"")

    def write_nowait(self, data: bytes) -> int:
        """Hand over as much of `data` as the line takes now; return how many bytes.

        Raises:
            DeviceError: The line is not open, or the device is gone.
        """
        return self._ask(self._port.write, data, default=len(data))

    def wait(self, seconds: float) -> None:
        """Wait until bytes have arrived, at most so long; not in a cycle.

        Raises:
            DeviceError: The line is not open, or the device is gone.
        """
        self._ask(self._port.wait, seconds, default=None)

    def discard_input(self) -> None:
        """Forget the bytes that have arrived and were not read.

        Raises:
            DeviceError: The line is not open, or the device is gone.
        """
        self._ask(self._port.discard, default=None)

    def close(self) -> None:
        """Close the line; see `SerialPort.close`."""
        self._opened = False
        self._port.close()

    def __enter__(self) -> Self:
        """Open the line."""
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the line."""
        self.close()

    def _ask(self, call: Callable[..., T], *args: object, default: T) -> T:
        """Return what the open line answers; it is closed when the device is gone."""
        if not self._opened:
            raise DeviceError(
                "the serial line is not open",
                where=self.path,
                remedy="call open() and wait for it to succeed",
            )
        try:
            return self._outside.ask(call, *args, default=default)
        except OSError as error:
            raise self._lost(error) from None

    def _lost(self, error: OSError) -> DeviceError:
        self.close()
        return DeviceError(
            "the device on the serial line is gone",
            where=self.path,
            got=os.strerror(error.errno) if error.errno else str(error),
            remedy="check the cable; open() tries again",
        )


def _distinguish_hangup(fd: int) -> None:
    """Make an empty line raise EAGAIN, so that zero bytes mean that it hung up.

    pyserial sets VMIN to 0, with which a read gives zero bytes in both cases.
    """
    os.set_blocking(fd, False)
    settings = termios.tcgetattr(fd)
    settings[6][termios.VMIN] = 1
    termios.tcsetattr(fd, termios.TCSANOW, settings)


def _is_sent(fd: int) -> bool:
    """Wait until all output is sent; return False when that takes too long."""
    ends = monotonic() + _LAST
    while struct.unpack("i", fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)))[0]:
        if monotonic() > ends:
            return False
        sleep(_AGAIN)
    return True
