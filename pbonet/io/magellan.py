"""The Magellan, or classic Space Mouse: a six-axis ball on a serial line.

The device speaks in lines of printable characters ended by CR, at 9600 baud, 8N1. Four
bits travel as one character of `NIBBLES`: its low half is the value, and its high half
makes the number of one bits even, so that a damaged character is noticed.

========  ====================================================================
``d``     deflection: six axes of four nibbles each, offset by 32768
``k``     buttons in three nibbles: 1 to 4, 5 to 8, and ``*``
``m``     the mode that was set; 3 reports translations and rotations
``v``     the version as text, asked for by ``vQ``
``z``     the present deflection was made the zero
========  ====================================================================

`Decoder` turns bytes into packets and does nothing else; `Ball` is the device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import DeviceError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .serial_line import SerialLine

NIBBLES = b"0AB3D56GH9:K<MN?"
AXES = 6
END = b"\r"
SET_UP = b"\r\rm3\rvQ\r"
"""End an incomplete command, report all six axes, report the version."""

_VALUE = {code: value for value, code in enumerate(NIBBLES)}
_OFFSET = 1 << 15
_MOTION_LENGTH = 1 + 4 * AXES
_KEYS_LENGTH = 1 + 3
_LONGEST = 64
"""No packet is longer; the version text is the longest, with about forty."""


class Motion(Struct, frozen=True):
    """How far the ball is pushed and turned: x, y, z, then about x, y, z; in counts."""

    axes: tuple[int, int, int, int, int, int]


AT_REST = Motion((0, 0, 0, 0, 0, 0))


class Keys(Struct, frozen=True):
    """Which buttons are held: bit 0 is button 1, bit 7 is button 8, bit 8 is ``*``."""

    mask: int


class Reply(Struct, frozen=True):
    """An answer to a command: its letter and the text after it."""

    kind: str
    text: str


Packet = Motion | Keys | Reply


class Decoder:
    """Turns a stream of bytes into packets, and finds its way back after garbage."""

    def __init__(self) -> None:
        self.damaged = 0
        """Packets and stretches of garbage that were thrown away."""
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Yield the packets that `data` completes, in order."""
        *lines, self._rest = (self._rest + data).split(END)
        for line in lines:
            if self._skipping:
                self._skipping = False
            elif line and (packet := self._decode(line)) is not None:
                yield packet
        if len(self._rest) > _LONGEST:
            self.damaged += not self._skipping
            self._rest, self._skipping = b"", True

    def _decode(self, line: bytes) -> Packet | None:
        packet: Packet | None = None
        if line[:1] == b"d":
            packet = _motion(line)
        elif line[:1] == b"k":
            packet = _keys(line)
        elif line.isascii() and line.decode().isprintable() and len(line) <= _LONGEST:
            packet = Reply(line[:1].decode(), line[1:].decode())
        self.damaged += packet is None
        return packet


def _nibbles(line: bytes, length: int) -> list[int] | None:
    if len(line) != length:
        return None
    values = [_VALUE.get(code, -1) for code in line[1:]]
    return None if -1 in values else values


def _motion(line: bytes) -> Motion | None:
    values = _nibbles(line, _MOTION_LENGTH)
    if values is None:
        return None
    x, y, z, a, b, c = (
        (values[k] << 12 | values[k + 1] << 8 | values[k + 2] << 4 | values[k + 3])
        - _OFFSET
        for k in range(0, 4 * AXES, 4)
    )
    return Motion((x, y, z, a, b, c))


def _keys(line: bytes) -> Keys | None:
    values = _nibbles(line, _KEYS_LENGTH)
    if values is None:
        return None
    return Keys(values[0] | values[1] << 4 | values[2] << 8)


class Ball:
    """A Magellan on a serial line, polled once a cycle.

    A poll reads what has arrived and never waits. When the device is gone, the ball is
    at rest (deflection zero, no button), and every `retry` seconds a poll tries to open
    the line again; that takes well under a millisecond.

    Args:
        line: The serial line; the ball opens and closes it.
        retry: Seconds between attempts to open the line.
        silence: Seconds without a motion packet after which the ball rests. A pushed
            ball reports about every 40 ms.
        work: Bytes that one poll reads at most.
    """

    def __init__(
        self,
        line: SerialLine,
        *,
        retry: float = 1.0,
        silence: float = 0.25,
        work: int = 256,
    ) -> None:
        self.version = ""
        """The device's identification; empty until it has answered."""
        self.fault: DeviceError | None = None
        """Why there is no device; None while there is one."""
        self.motion = AT_REST
        self.keys = Keys(0)
        self._line = line
        self._retry_ns = int(retry * 1e9)
        self._silence_ns = int(silence * 1e9)
        self._work = work
        self._decoder = Decoder()
        self._unsent = b""
        self._next_try_ns: int | None = None
        self._heard_ns = 0

    @property
    def damaged(self) -> int:
        """Packets that were thrown away since the line was opened."""
        return self._decoder.damaged

    def poll(self, now_ns: int) -> Motion:
        """Return the present deflection.

        Args:
            now_ns: The time, in nanoseconds of any one clock.
        """
        try:
            if self._line.is_open or self._open(now_ns):
                self._exchange(now_ns)
        except DeviceError as error:
            self._lost(error, now_ns)
        if now_ns - self._heard_ns > self._silence_ns:
            self.motion = AT_REST
        return self.motion

    def restart(self) -> None:
        """Discard what the ball sent between polls, and set it up again."""
        if self._line.is_open:
            try:
                self._line.discard_input()
            except DeviceError as error:
                self.fault = error
            else:
                self._unsent = SET_UP
        self._decoder = Decoder()
        self.motion, self.keys = AT_REST, Keys(0)

    def close(self) -> None:
        """Let go of the line; the next poll opens it again."""
        self._line.close()
        self._rest()
        self._next_try_ns = None

    def _open(self, now_ns: int) -> bool:
        if self._next_try_ns is not None and now_ns < self._next_try_ns:
            return False
        self._next_try_ns = now_ns + self._retry_ns
        self._line.open()
        self.fault = None
        self.version = ""
        self._decoder = Decoder()
        self._unsent = SET_UP
        return True

    def _exchange(self, now_ns: int) -> None:
        if self._unsent:
            self._unsent = self._unsent[self._line.write_nowait(self._unsent) :]
        for packet in self._decoder.feed(self._line.read_available(self._work)):
            if isinstance(packet, Motion):
                self.motion = packet
                self._heard_ns = now_ns
            elif isinstance(packet, Keys):
                self.keys = packet
            elif packet.kind == "v":
                self.version = packet.text.strip()

    def _lost(self, error: DeviceError, now_ns: int) -> None:
        self.fault = error
        self._next_try_ns = now_ns + self._retry_ns
        self._rest()

    def _rest(self) -> None:
        self.motion = AT_REST
        self.keys = Keys(0)
        self._unsent = b""
