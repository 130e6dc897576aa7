"""Parameter groups of J1939 on a CAN bus: class SIO, driver ``j1939``.

The address is the interface, such as ``can0``. The kernel carries groups of up to 1785
bytes over several frames, in both directions (its module ``can-j1939``). Each port is
an end of its own: it has what others send to all, and to its own address.

It was not run with hardware here.
"""

from __future__ import annotations

import errno
import socket
import struct
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final, NamedTuple

from msgspec import Meta

from pbonet.errors import DeviceError

from .device import Settings
from .device_classes import FrameDevice
from .modes import Mode
from .stream_waits import read_pieces, write_all

if TYPE_CHECKING:
    from collections.abc import Sequence

_MOST: Final = 1785
"""Bytes of a group."""
TO_ALL: Final = 0xFF
"""The destination that means all."""
_LEVEL: Final = 107
"""SOL_CAN_J1939 of <linux/can/j1939.h>."""
_PROMISCUOUS, _PRIORITY, _DESTINATION = 2, 3, 1
"""Options of such a socket, and what it says beside a group."""
_STAMPS: Final = 35
"""SO_TIMESTAMPNS of <asm-generic/socket.h>."""
_LARGEST_PGN: Final = 0x3FFFF
_SPECIFIC: Final = 0xF000
"""Groups whose number is below this, in its low 16 bits, have a destination."""
_FULL: Final = frozenset({errno.EAGAIN, errno.ENOBUFS})
_GONE: Final = frozenset({errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF})
_STAMP: Final = struct.Struct("@qq")
_ANCILLARY: Final = 256


class J1939Settings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of an end on a bus of J1939."""

    source: A[int, Meta(ge=0, le=253)]
    """The own address."""
    priority: A[int, Meta(ge=0, le=7)] = 6
    """Of what is sent; 0 is the highest."""
    listen: bool = False
    """Whether groups that are for other addresses are read, too."""


class Group(NamedTuple):
    """A parameter group."""

    pgn: int
    """Its number; of one with a destination the low byte is 0."""
    data: bytes = b""
    destination: int = TO_ALL
    source: int = 0
    """The address of its sender; the own one is sent."""
    stamp_ns: int = 0
    """Nanoseconds since 1970 at its arrival, by the kernel."""


class J1939Device(FrameDevice[Group]):
    """An end on a bus."""

    settings_type: ClassVar[type[Settings]] = J1939Settings
    safe_type = list[Group]

    def connect(self) -> None:
        """Open the bus; see `Device.connect`."""
        self._held: list[tuple[Any, ...]] = []
        k = self.settings
        try:
            one = socket.socket(
                socket.AF_CAN,
                socket.SOCK_DGRAM | socket.SOCK_NONBLOCK,
                socket.CAN_J1939,
            )
        except OSError as error:
            raise self._unusable(error) from None
        try:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            one.setsockopt(socket.SOL_SOCKET, _STAMPS, 1)
            one.setsockopt(_LEVEL, _PRIORITY, k.priority)
            one.setsockopt(_LEVEL, _PROMISCUOUS, int(k.listen))
            one.bind((
                self.entry.address,
                socket.J1939_NO_NAME,
                socket.J1939_NO_PGN,
                k.source,
            ))
        except OSError as error:
            one.close()
            raise self._unusable(error) from None
        self._socket = one

    def disconnect(self) -> None:
        """Close the bus."""
        self._socket.close()

    def read(self, count: int) -> list[Group]:
        """Return groups that have arrived; see `FrameDevice.read`."""
        self.require(Mode.READ)
        return [Group(*one) for one in self.ask(self._read, count, default=[])]

    def _read(self, count: int) -> list[tuple[Any, ...]]:
        fd, wait = self._socket.fileno(), self.opening.wait
        return read_pieces(fd, self._taken, count, wait, self._held)

    def _taken(self, limit: int) -> list[tuple[Any, ...]]:
        """Return groups that have arrived, at most so many; empty if none has."""
        found: list[tuple[Any, ...]] = []
        while len(found) < limit:
            try:
                data, told, _, where = self._socket.recvmsg(_MOST, _ANCILLARY)
            except BlockingIOError:
                break
            if where[3] == self.settings.source:
                continue  # the kernel passes on what is sent in several frames
            known = {(level, kind): value for level, kind, value in told}
            to = known.get((_LEVEL, _DESTINATION), bytes((TO_ALL,)))[0]
            stamp = known.get((socket.SOL_SOCKET, _STAMPS), bytes(_STAMP.size))
            seconds, rest = _STAMP.unpack(stamp)
            _, _, pgn, source = where
            found.append((pgn, data, to, source, seconds * 1_000_000_000 + rest))
        return found

    def write(self, frames: Sequence[Group]) -> int:
        """Hand groups over; see `FrameDevice.write`."""
        self.require(Mode.WRITE)
        for one in frames:
            self.check_piece(one)
        done: int = self.ask(self._write, frames, default=len(frames))
        return done

    def _write(self, frames: Sequence[Group]) -> int:
        fd, wait = self._socket.fileno(), self.opening.wait
        return write_all(fd, self._give, frames, wait, self.patience)

    def _give(self, frames: Sequence[Group]) -> int:
        """Hand over what there is room for; return how many groups.

        Raises:
            DeviceError: The destination did not take an earlier one.
            OSError: The device is gone.
        """
        name, done = self.entry.address, 0
        for one in frames:
            to = (name, socket.J1939_NO_NAME, one.pgn, one.destination)
            try:
                self._socket.sendto(one.data, to)
            except OSError as error:
                if error.errno in _FULL:
                    break
                if error.errno in _GONE:
                    raise
                raise DeviceError(
                    "a group did not reach its destination",
                    where=f"{self.name} ({name})",
                    expected="a node with that address",
                    got=error.strerror or str(error),
                    remedy="check the address, and that this node is switched on",
                ) from None
            done += 1
        return done

    def check_piece(self, one: Group) -> None:
        """Refuse a group that this bus cannot have.

        Raises:
            DeviceError: It cannot.
        """
        is_specific = one.pgn & 0xFFFF < _SPECIFIC
        expected = [
            ("a number of 0 to 3FFFFh", 0 <= one.pgn <= _LARGEST_PGN),
            ("a number with the low byte 0", not is_specific or not one.pgn & 0xFF),
            (f"1 to {_MOST} bytes", 0 < len(one.data) <= _MOST),
            ("a destination of 0 to 255", 0 <= one.destination <= TO_ALL),
            ("no destination", is_specific or one.destination == TO_ALL),
        ]
        for text, is_so in expected:
            if not is_so:
                raise DeviceError(
                    "the bus has no such groups",
                    where=f"{self.name} ({self.entry.address})",
                    expected=text,
                    got=f"{one.pgn:X}h, {len(one.data)} bytes, to {one.destination}",
                    remedy="see Group in docs/devices.md",
                )

    def _unusable(self, error: OSError) -> DeviceError:
        return DeviceError(
            "the bus of J1939 cannot be opened",
            where=f"{self.name} ({self.entry.address})",
            expected="an interface of CAN, and a kernel with can-j1939",
            got=error.strerror or str(error),
            remedy="`modprobe can-j1939`; `ip link set can0 up`; priorities 0 and 1 "
            "need the right CAP_NET_ADMIN",
        )
