"""Joysticks and game pads, as the input devices of Linux.

The kernel gives events of 24 bytes: time, kind, code and value (``linux/input.h``). No
library is needed for that.
"""

from __future__ import annotations

import errno
import os
import struct
from contextlib import suppress
from fcntl import ioctl
from typing import TYPE_CHECKING, NamedTuple

from pbonet.errors import DeviceError
from pbonet.outside import Outside

from .policy import require_devices

if TYPE_CHECKING:
    from collections.abc import Sequence

EVENT = struct.Struct("@llHHi")
"""Seconds, microseconds, kind, code, value."""
SYN, KEY, ABS = 0, 1, 3
"""Kinds of events: a mark between them, a button, an axis."""
DROPPED = 3
"""The code of the mark that says that events were lost."""
_ABSINFO = struct.Struct("@6i")
_KEYS = 96
"""Bytes of the kernel's table of keys: 768 bits."""


def get_axis(code: int) -> int:
    """Return the number of the request for value and range of an axis (EVIOCGABS)."""
    return 2 << 30 | _ABSINFO.size << 16 | ord("E") << 8 | 0x40 + code


GET_KEYS = 2 << 30 | _KEYS << 16 | ord("E") << 8 | 0x18
"""The request for all keys that are held (EVIOCGKEY)."""


class Stick(NamedTuple):
    """Where a joystick stands."""

    axes: tuple[float, ...]
    """-1 to 1, in the order that was asked for."""
    buttons: int
    """One bit for each button that is held, the first one the lowest."""


class Joystick:
    """A joystick that never blocks.

    When it is lost it rests, and is looked for again after `retry` seconds.

    Args:
        path: The device file, such as ``/dev/input/by-id/...-event-joystick``.
        axes: Codes of the axes, as ``evtest`` shows them: ABS_X is 0, ABS_Y 1.
        buttons: Codes of the buttons: BTN_SOUTH is 304.
        retry: Seconds between two attempts to open it.
        work: Largest number of events that one poll reads.

    Attributes:
        fault: Why there is no device; None while there is one.
    """

    def __init__(
        self,
        path: str,
        axes: Sequence[int],
        buttons: Sequence[int],
        *,
        retry: float = 1.0,
        work: int = 64,
    ) -> None:
        self.fault: DeviceError | None = None
        self._path, self._codes = path, tuple(axes)
        self._bits = {code: 1 << k for k, code in enumerate(buttons)}
        self._outside = Outside(f"joystick {path}")
        self._retry_ns, self._work = round(retry * 1e9), work
        self._next_try_ns: int | None = None
        self._fd: int | None = None
        self._opened = False
        self._rest()

    def poll(self, now_ns: int) -> Stick:
        """Return where the joystick stands.

        Args:
            now_ns: The time, in nanoseconds of any one clock.
        """
        try:
            if self._opened or self._open(now_ns):
                self._read()
        except OSError as error:  # also a DeviceError
            self.close()
            self.fault = self._lost(error)
            self._next_try_ns = now_ns + self._retry_ns
        return Stick(
            tuple(self._share(code) for code in self._codes),
            sum(bit for code, bit in self._bits.items() if code in self._held),
        )

    def close(self) -> None:
        """Let go of the device; the next poll opens it again."""
        fd, self._fd, self._opened = self._fd, None, False
        self._next_try_ns = None
        self._rest()
        if fd is not None:
            with suppress(OSError):
                os.close(fd)

    def _rest(self) -> None:
        self._values: dict[int, int] = {}
        self._ranges: dict[int, tuple[int, int]] = {}
        self._held: set[int] = set()

    def _share(self, code: int) -> float:
        """Return an axis as -1 to 1; 0 while it is not known."""
        if code not in self._values:
            return 0.0
        low, high = self._ranges[code]
        share = (2.0 * self._values[code] - low - high) / (high - low)
        return min(max(share, -1.0), 1.0)

    def _open(self, now_ns: int) -> bool:
        if self._next_try_ns is not None and now_ns < self._next_try_ns:
            return False
        require_devices(self._path)
        self._take(self._outside.ask(self._connect, default=None))
        self._opened, self.fault = True, None
        return True

    def _connect(self) -> tuple[list[int], bytes]:
        self._fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        return self._state()

    def _state(self) -> tuple[list[int], bytes]:
        """Return value, least and largest of each axis, and the table of keys."""
        fd = self._descriptor()
        numbers: list[int] = []
        for code in self._codes:
            data = ioctl(fd, get_axis(code), bytes(_ABSINFO.size))
            numbers += _ABSINFO.unpack(data)[:3]
        return numbers, ioctl(fd, GET_KEYS, bytes(_KEYS))

    def _take(self, state: tuple[list[int], bytes] | None) -> None:
        if state is None:
            return
        numbers, keys = state
        for k, code in enumerate(self._codes):
            value, low, high = numbers[3 * k : 3 * k + 3]
            if low < high:  # an axis that the device does not have has no range
                self._values[code], self._ranges[code] = value, (low, high)
        self._held = {code for code in self._bits if keys[code // 8] >> (code % 8) & 1}

    def _read(self) -> None:
        data: bytes = self._outside.ask(self._events, default=b"")
        for _, _, kind, code, value in EVENT.iter_unpack(data):
            if kind == SYN and code == DROPPED:
                self._take(self._outside.ask(self._state))
                return
            if kind == ABS and code in self._values:
                self._values[code] = value
            elif kind == KEY and code in self._bits:
                (self._held.add if value else self._held.discard)(code)

    def _events(self) -> bytes:
        try:
            return os.read(self._descriptor(), self._work * EVENT.size)
        except BlockingIOError:
            return b""

    def _descriptor(self) -> int:
        if self._fd is None:
            raise OSError(errno.ENODEV, "the joystick is closed")
        return self._fd

    def _lost(self, error: OSError) -> DeviceError:
        if isinstance(error, DeviceError):
            return error
        remedies = {
            errno.ENOENT: "check cable and name; `ls /dev/input/by-id` lists devices",
            errno.EACCES: "add the user to the group that owns it, often `input`",
            errno.ENOTTY: "give the file of an input device, .../event*",
        }
        return DeviceError(
            "there is no joystick",
            where=self._path,
            got=os.strerror(error.errno) if error.errno else str(error),
            remedy=remedies.get(error.errno or 0, "check the cable"),
        )
