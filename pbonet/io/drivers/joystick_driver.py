"""Joysticks and game pads, as input devices of Linux: class ADC, driver ``joystick``.

The address is the device file, ``/dev/input/by-id/...-event-joystick``. Ports are the
axes of the settings, and then the buttons, each with its code of the kernel. An axis
has a sign; `status("RANGE", port)` gives its least and largest value.

The kernel gives events of 24 bytes: time, kind, code and value (``linux/input.h``). No
library is needed for that.

Its tests have recorded events on a pipe, and uinput in User-Mode Linux. It was not run
with hardware here.
"""

from __future__ import annotations

import errno
import os
import struct
from fcntl import ioctl
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final

from msgspec import Meta

from pbonet.errors import DeviceError

from .device import Kind, Settings
from .device_classes import PortDevice
from .modes import Mode

if TYPE_CHECKING:
    from pbonet.config import Entry
    from pbonet.outside import Outside

    from .modes import Opening
    from .port_claims import Claim

EVENT: Final = struct.Struct("@llHHi")
"""Seconds, microseconds, kind, code, value."""
SYN, KEY, ABS = 0, 1, 3
"""Kinds of events: a mark between them, a button, an axis."""
DROPPED: Final = 3
"""The code of the mark that says that events were lost."""
ABSINFO: Final = struct.Struct("@6i")
_KEYS: Final = 96
"""Bytes of the kernel's table of keys: 768 bits."""
_AT_ONCE: Final = 64
"""Events that one read takes."""
_AXIS_BITS: Final = 32


def get_axis(code: int) -> int:
    """Return the number of the request for value and range of an axis (EVIOCGABS)."""
    return 2 << 30 | ABSINFO.size << 16 | ord("E") << 8 | 0x40 + code


GET_KEYS: Final = 2 << 30 | _KEYS << 16 | ord("E") << 8 | 0x18
"""The request for all keys that are held (EVIOCGKEY)."""


class JoystickSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a joystick: codes, as ``evtest`` shows them."""

    axes: tuple[A[int, Meta(ge=0, le=63)], ...] = (0, 1)
    """ABS_X is 0, ABS_Y 1."""
    buttons: tuple[A[int, Meta(ge=0, le=767)], ...] = (304, 305, 307, 308)
    """BTN_SOUTH is 304."""


class JoystickDevice(PortDevice):
    """Axes and buttons, where they are now; a read never waits."""

    kind: ClassVar[Kind] = "ADC"
    can = Mode.READ
    settings_type: ClassVar[type[Settings]] = JoystickSettings

    def __init__(self, entry: Entry, opening: Opening, outside: Outside) -> None:
        super().__init__(entry, opening, outside)
        k = self.settings
        codes: list[tuple[int, int]] = [(ABS, code) for code in k.axes]
        codes += [(KEY, code) for code in k.buttons]
        self._codes = codes[entry.first :]
        self.check_ports(len(self._codes))
        self._opened = self._codes[opening.start : opening.end + 1]

    def open(self, claim: Claim | None) -> None:
        """Open the device, and note the axes' ranges; see `Device.open`."""
        super().open(claim)
        self._ranges: list[list[int]] = self.ask(lambda: self._found, default=[])

    def connect(self) -> None:
        """Open the device; see `Device.connect`."""
        self._values: dict[tuple[int, int], int] = {}
        self._fd = -1
        try:
            self._fd = os.open(
                self.entry.address, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
            )
            self._found = [self._range(*one) for one in self._codes]
            self._ask_kernel()
        except OSError as error:
            self.disconnect()
            raise self._unusable(error) from None

    def disconnect(self) -> None:
        """Close the device."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known: ``RANGE`` gives a port's least and largest value."""
        if command == "PORTNUM":
            return self.entry.ports or len(self._codes)
        if command == "RANGE":
            low, high = self._ranges[port]
            return low, high
        return super().status(command, port)

    def port_bits(self, port: int) -> int:
        """Return how many bits a port has: 32, of buttons 1."""
        return _AXIS_BITS if self._codes[port][0] == ABS else 1

    def read_ports(self) -> list[int]:
        """Return where axes and buttons are after the events that have come."""
        try:
            data = os.read(self._fd, _AT_ONCE * EVENT.size)
        except BlockingIOError:
            data = b""
        else:
            if not data or len(data) % EVENT.size:
                raise OSError(errno.ENODEV, "it gives no events any more")
        for _, _, kind, code, value in EVENT.iter_unpack(data):
            if kind == SYN and code == DROPPED:
                self._ask_kernel()
                break  # what follows is older, or comes again
            if (kind, code) in self._values:
                self._values[kind, code] = value if kind == ABS else int(value != 0)
        return [self._values[one] for one in self._opened]

    def _ask_kernel(self) -> None:
        """Take all values from the kernel."""
        keys: bytes = ioctl(self._fd, GET_KEYS, bytes(_KEYS))
        for kind, code in self._codes:
            held = keys[code // 8] >> (code % 8) & 1
            self._values[kind, code] = self._axis(code)[0] if kind == ABS else held

    def _axis(self, code: int) -> tuple[int, int, int]:
        """Return value, least and largest of an axis."""
        data = ioctl(self._fd, get_axis(code), bytes(ABSINFO.size))
        value, low, high, *_ = ABSINFO.unpack(data)
        return value, low, high

    def _range(self, kind: int, code: int) -> list[int]:
        """Return the least and the largest value of a port.

        Raises:
            DeviceError: The device has no such axis.
        """
        if kind != ABS:
            return [0, 1]
        _, low, high = self._axis(code)
        if low >= high:
            raise DeviceError(
                "the joystick has no such axis",
                where=f"{self.name} ({self.entry.address})",
                got=f"code {code}",
                remedy="`evtest` shows the codes; see axes in agent.toml",
            )
        return [low, high]

    def _unusable(self, error: OSError) -> DeviceError:
        if isinstance(error, DeviceError):
            return error
        remedies = {
            errno.ENOENT: "check cable and name; `ls /dev/input/by-id` lists devices",
            errno.EACCES: "add the user to the group that owns it, often `input`",
        }
        return DeviceError(
            "there is no joystick",
            where=f"{self.name} ({self.entry.address})",
            got=os.strerror(error.errno) if error.errno else str(error),
            remedy=remedies.get(
                error.errno or 0, "give the file of an input device, .../event*"
            ),
        )
