"""The SpaceMouse and its kin of 3Dconnexion: a cap that is pushed and turned, by USB.

The kernel hands over each report of the device as it is (``/dev/hidrawN``), so that no
driver and no library is needed. The first byte names the report, numbers are of two
bytes, the lower first:

====  ==========================================================================
1     x, y, z; of newer devices then the turns about x, y, z too
2     the turns about x, y, z
3     the buttons that are held, a bit each, the first one the lowest
====  ==========================================================================

x points to the right, y to the person, z down; 350 is a full push. A cap that is pushed
reports about a hundred times a second, and a last time with zeros when it is let go. At
rest it reports nothing, and a button that is held does not either.
"""

from __future__ import annotations

import errno
import os
import struct
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from pbonet.errors import DeviceError
from pbonet.outside import Outside

from .policy import require_devices

FULL = 350.0
"""Counts of a full push."""
_THREE, _SIX = struct.Struct("<3h"), struct.Struct("<6h")
_PUSH, _TURN, _KEYS = 1, 2, 3
_BITS = 0x7FFFFFFF
_LONGEST = 64
"""Bytes of a report at most."""
_SYSTEM = Path("/sys/class/hidraw")
_open = os.open
_MAKER = 0x256F
_FORMER_MAKER = 0x046D
"""Logitech, of which these are the devices of 3Dconnexion."""
_FORMER = frozenset({
    *(0xC603, 0xC605, 0xC606, 0xC621, 0xC623, 0xC625, 0xC626, 0xC627, 0xC628, 0xC629),
    0xC62B,
})
_AT_REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Cap(NamedTuple):
    """How a SpaceMouse is held."""

    axes: tuple[float, ...]
    """Pushes along x, y, z and turns about them, -1 to 1."""
    buttons: int
    """One bit for each button that is held."""


def find_space_mouse() -> str:
    """Return the device file of the first SpaceMouse that is plugged in.

    Raises:
        FileNotFoundError: There is none.
    """
    for about in sorted(_SYSTEM.glob("*/device/uevent")):
        lines = about.read_text(encoding="utf-8", errors="replace").splitlines()
        for line in lines:
            name, _, value = line.partition("=")
            if name == "HID_ID" and _is_one(value):
                return f"/dev/{about.parts[-3]}"
    raise FileNotFoundError(errno.ENOENT, "no device of 3Dconnexion is plugged in")


def _is_one(text: str) -> bool:
    """Return whether bus, maker and product are those of a SpaceMouse."""
    try:
        _, maker, product = (int(word, 16) for word in text.split(":"))
    except ValueError:
        return False
    return maker == _MAKER or (maker == _FORMER_MAKER and product in _FORMER)


class SpaceMouse:
    """A SpaceMouse that never blocks.

    When it is lost it rests, and is looked for again after `retry` seconds: under
    another name, if none was given.

    Args:
        path: Its device file; empty: that of the first one that is plugged in.
        retry: Seconds between two attempts to open it.
        silence: Seconds without a report of a pushed cap after which it is out of
            reach: it rests, and no button is held until the next report of buttons.
        held: Seconds without a report after which no button of a cap at rest is held
            either: a wireless device may be out of reach. What was let go meanwhile was
            not heard, so that again a report of buttons is waited for.
        work: Reports that one poll reads at most.

    Attributes:
        fault: Why there is no device; None while there is one.
    """

    def __init__(
        self,
        path: str = "",
        *,
        retry: float = 1.0,
        silence: float = 0.25,
        held: float = 2.0,
        work: int = 64,
    ) -> None:
        self.fault: DeviceError | None = None
        self._path, self._work = path, work
        self._outside = Outside(f"SpaceMouse {path}".rstrip())
        self._retry_ns, self._silence_ns = round(retry * 1e9), round(silence * 1e9)
        self._held_ns = round(held * 1e9)
        self._next_try_ns: int | None = None
        self._heard_ns = self._alive_ns = 0
        self._fd: int | None = None
        self._opened = False
        self._axes, self._buttons = list(_AT_REST), 0

    def poll(self, now_ns: int) -> Cap:
        """Return how it is held.

        Args:
            now_ns: The time, in nanoseconds of any one clock.
        """
        try:
            if self._opened or self._open(now_ns):
                self._read(now_ns)
        except OSError as error:  # also a DeviceError
            self.close()
            self.fault = self._lost(error)
            self._next_try_ns = now_ns + self._retry_ns
        if now_ns - self._heard_ns > self._silence_ns and any(self._axes):
            self._axes[:], self._buttons = _AT_REST, 0
        if now_ns - self._alive_ns > self._held_ns:
            self._buttons = 0
        return Cap(tuple(self._axes), self._buttons)

    def close(self) -> None:
        """Let go of the device; the next poll opens it again."""
        fd, self._fd, self._opened = self._fd, None, False
        self._next_try_ns = None
        self._axes[:], self._buttons = _AT_REST, 0
        if fd is not None:
            with suppress(OSError):
                os.close(fd)

    def _open(self, now_ns: int) -> bool:
        if self._next_try_ns is not None and now_ns < self._next_try_ns:
            return False
        require_devices(self._path or "a SpaceMouse")
        self._outside.ask(self._connect, default=None)
        self._opened, self.fault = True, None
        return True

    def _connect(self) -> None:
        path = self._path or find_space_mouse()
        self._fd = _open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)

    def _read(self, now_ns: int) -> None:
        reports: tuple[bytes, ...] = self._outside.ask(self._reports, default=())
        for report in reports:
            self._take(report, now_ns)

    def _take(self, report: bytes, now_ns: int) -> None:
        """Take one report; what is none of these changes nothing."""
        kind, data = report[0], report[1:]
        if kind == _KEYS and data:
            self._alive_ns = now_ns
            self._buttons = int.from_bytes(data[:4], "little") & _BITS
        if kind not in {_PUSH, _TURN} or len(data) < _THREE.size:
            return
        self._heard_ns = self._alive_ns = now_ns
        first = 0 if kind == _PUSH else _THREE.size // 2
        count = 6 if kind == _PUSH and len(data) >= _SIX.size else 3
        numbers = struct.unpack_from(f"<{count}h", data)
        for place, number in enumerate(numbers, first):
            self._axes[place] = min(max(number / FULL, -1.0), 1.0)

    def _reports(self) -> tuple[bytes, ...]:
        """Return the reports that have come; the kernel hands over one at a time."""
        if self._fd is None:
            raise OSError(errno.ENODEV, "the SpaceMouse is closed")
        found: list[bytes] = []
        for _ in range(self._work):
            try:
                report = os.read(self._fd, _LONGEST)
            except BlockingIOError:
                break
            if not report:
                raise OSError(errno.ENODEV, "the SpaceMouse hung up")
            found.append(report)
        return tuple(found)

    def _lost(self, error: OSError) -> DeviceError:
        if isinstance(error, DeviceError):
            return error
        remedies = {
            errno.ENOENT: "plug it in; `ls /sys/class/hidraw` lists what there is",
            errno.EACCES: "let udev give its group the right to read the device file",
        }
        return DeviceError(
            "there is no SpaceMouse",
            where=self._path or "/dev/hidraw*",
            got=error.strerror or str(error),
            remedy=remedies.get(error.errno or 0, "check the cable"),
        )
