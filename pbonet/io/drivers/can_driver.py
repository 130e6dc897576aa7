"""A CAN bus: class SIO, driver ``can``.

The address is the channel, such as ``can0``. Frames that are not read wait in the
interface; when there is no more room, SocketCAN drops the newest.
"""

from __future__ import annotations

import errno
import fcntl
import math
import os
import select
import socket
import time
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io import from_extra

from .device import Device, Settings
from .device_classes import Frame, FrameDevice
from .modes import Mode, Wait
from .stream_waits import no_room

if TYPE_CHECKING:
    from collections.abc import Sequence

_FILTER: Final = r"^([0-7]?[0-9a-fA-F]{1,2}|[01]?[0-9a-fA-F]{4,7})/[0-9a-fA-F]{1,8}$"
_STANDARD_DIGITS: Final = 3
_LARGEST_ID: Final = {False: 0x7FF, True: 0x1FFFFFFF}
_FD_LENGTHS: Final = frozenset({*range(9), 12, 16, 20, 24, 32, 48, 64})
_LENGTHS: Final = frozenset(range(9))
_BUS_OFF: Final = 0x40
"""Bit of an error frame's identity: the controller has left the bus."""
_ROOM: Final = 1024
"""Frames that the virtual bus keeps for one end."""
_REFUSALS: Final = (OSError, ValueError, TypeError, ImportError, NotImplementedError)
"""Errors of interfaces for settings that they do not have, beside their own ones."""
_NO_FRAME: Final = (ValueError, LookupError)
"""Errors of python-can at a line that is damaged, some as the cause of its own."""
_LONGEST_LINE: Final = 256
"""Bytes without the end of a line; the longest, of CAN FD with its time, has 143."""
_AGAIN: Final = 0.001
"""Seconds after which a full interface is tried again."""
_NONE: Final = ({"can_id": 0x20000000, "can_mask": 0},)
"""Filters of the kernel that no frame passes: the inverse of one that all pass."""


class BusSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """Settings of what is on a CAN bus: how the bus is reached."""

    interface: str = "socketcan"
    """Interface of python-can."""
    bitrate: int = 0
    """Bits a second; 0: as the interface is set. The system sets SocketCAN's."""
    settle: A[float, Meta(ge=0.0)] = 0.0
    """Seconds that an adapter on a serial line (slcan) needs after it was opened."""

    def __post_init__(self) -> None:
        """Refuse what would do nothing.

        Raises:
            ValueError: A bit rate of SocketCAN, or a time for another than slcan.
        """
        if self.settle and self.interface != "slcan":
            raise ValueError("only the interface slcan takes settle")
        if self.bitrate and self.interface == "socketcan":
            raise ValueError(
                "socketcan takes no bitrate: `ip link set can0 type can bitrate N`"
            )


class CanSettings(BusSettings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a CAN bus."""

    fd: bool = False
    """Whether frames of CAN FD are sent and received, too."""
    filters: tuple[A[str, Meta(pattern=_FILTER)], ...] = ()
    """``ID/MASK`` in hexadecimal digits: which frames are received; none: all. An
    identity of more than three digits is an extended one."""


class CanBus:
    """A channel of a CAN bus, as python-can has it; each is a socket of its own.

    Args:
        device: The device that is on it.
        filters: Identity and mask of what is received; none: all frames.
        reads: Whether frames are received; else `send` drops those that have come.
        more: What else the interface is asked for.

    Raises:
        DeviceError: It cannot be opened, or python-can is not installed.
    """

    def __init__(
        self,
        device: Device,
        filters: Sequence[dict[str, Any]],
        *,
        reads: bool = True,
        **more: object,
    ) -> None:
        with from_extra("can", f"the device {device.name}"):
            self._can: Any = import_module("can")
        k = device.settings
        self._where = f"{device.name} ({device.entry.address})"
        in_kernel = k.interface == "socketcan"
        # recv() of python-can stops at each frame that its own filters refuse.
        self._filters: Sequence[dict[str, Any]] = () if in_kernel else filters
        self._drops, self._line = not reads, k.interface == "slcan"
        if k.bitrate:
            more["bitrate"] = k.bitrate
        if in_kernel and (filters or not reads):
            more["can_filters"] = filters or _NONE
        if k.interface == "virtual":
            more["rx_queue_size"] = _ROOM
        if self._line:
            more["sleep_after_open"] = k.settle
        self._lock = self._locked(device.entry.address) if self._line else -1
        try:
            self._bus: Any = self._can.Bus(
                channel=device.entry.address,
                interface=k.interface,
                ignore_config=True,
                **more,
            )
        except (self._can.CanError, *_REFUSALS) as error:
            self._unlock()
            raise self._unusable(str(error)) from None
        # Without a number, these two have no room.
        known = k.interface in {"socketcan", "virtual"}
        self._full = {errno.ENOBUFS, errno.EAGAIN, *([None] if known else [])}
        if in_kernel and (
            number := self._bus.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        ):
            self.close()
            raise self._unusable(os.strerror(number))

    def close(self) -> None:
        """Close the channel."""
        with suppress(self._can.CanError, OSError):
            self._bus.shutdown()
        self._unlock()

    def receive(self, seconds: float | None) -> Any:  # noqa: ANN401 - of python-can
        """Return the next message that passes; None: none has come in that time.

        Args:
            seconds: None: it waits for one.

        Raises:
            DeviceError: What an adapter on a serial line sends is no frame.
            OSError: The device is gone.
        """
        ends = None if seconds is None else time.monotonic() + seconds
        while True:
            try:
                one = self._next(seconds)
            except self._can.CanError as error:
                raise _lost(error) from None
            if one is None:
                return None
            if one.is_error_frame:
                _check_bus(one)
            elif self._passes(one):
                return one
            seconds = _left(ends)

    def _next(self, seconds: float | None) -> Any:  # noqa: ANN401 - of python-can
        """Return the next message, or None.

        On a serial line python-can's own recv() waits for 1 ms at least, stops at each
        line that is no frame, as an acknowledgement, and takes part of a frame for it.
        """
        if not self._line:
            return self._bus.recv(seconds)
        ends = None if seconds is None else time.monotonic() + seconds
        while select.select([self._bus], [], [], _left(ends))[0]:
            try:
                one = self._bus.recv(0)
            except (*_NO_FRAME, self._can.CanError) as error:
                if not isinstance(error.__cause__ or error, _NO_FRAME):
                    raise
                self._bus.flush()  # else it would keep bytes that are no text
                raise self._garbled() from None
            if one is not None:
                if not _is_whole(one):
                    raise self._garbled()
                return one
            if len(self._bus._buffer) > _LONGEST_LINE:  # noqa: SLF001 - it has no limit
                self._bus.flush()
                raise self._garbled()
        return None

    def send(self, identity: int, data: bytes, **more: object) -> bool:
        """Hand a frame over; return False if there is no room for it now.

        Raises:
            OSError: The device is gone.
        """
        if self._drops:
            self._drop()
        if self._line and not select.select([], [self._bus], [], 0)[1]:
            return False
        message = self._can.Message(arbitration_id=identity, data=data, **more)
        try:
            self._bus.send(message, timeout=0)
        except self._can.CanTimeoutError:
            return False
        except self._can.CanError as error:
            if error.error_code in self._full:
                return False
            raise _lost(error) from None
        return True

    def _drop(self) -> None:
        """Drop what has come: who does not read it learns only that the bus is gone."""
        while True:
            with suppress(DeviceError):
                if self.receive(0) is None:
                    return

    def _passes(self, one: Any) -> bool:  # noqa: ANN401 - a message of python-can
        """Return whether a filter lets a message pass; the kernel's were before."""
        return not self._filters or any(
            not (one.arbitration_id ^ f["can_id"]) & f["can_mask"]
            and one.is_extended_id == f["extended"]
            for f in self._filters
        )

    def _locked(self, address: str) -> int:
        """Return a descriptor that keeps others from a serial line, or -1.

        Two that read from one would each have some of its bytes.

        Raises:
            DeviceError: Another one has it.
        """
        path, _, _ = address.partition("@")
        try:
            fd = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # opening it says why
            return -1
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(fd)
            raise self._unusable("an adapter that is open already") from None
        return fd

    def _unlock(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def _garbled(self) -> DeviceError:
        return DeviceError(
            "what the CAN adapter sends is no frame",
            where=self._where,
            expected="lines of the slcan protocol",
            remedy="check its cable; append @BAUD to the address; open it once only",
        )

    def _unusable(self, got: str) -> DeviceError:
        return DeviceError(
            "the CAN bus cannot be opened",
            where=self._where,
            expected="the channel of an interface that is up",
            got=got,
            remedy="check the settings; for SocketCAN: `ip link set can0 up`",
        )


class CanDevice(FrameDevice[Frame]):
    """A channel of a CAN bus; each opened port is a socket of its own."""

    settings_type: ClassVar[type[Settings]] = CanSettings
    packages: ClassVar[tuple[str, ...]] = ("can",)

    def connect(self) -> None:
        """Open the channel; see `Device.connect`."""
        k = self.settings
        filters = [_filter(one) for one in k.filters]
        reads = Mode.READ in self.opening.mode
        more = {"fd": True} if k.fd else {}
        self._bus = CanBus(self, filters, reads=reads, **more)
        self._held: list[tuple[Any, ...]] = []

    def disconnect(self) -> None:
        """Close the channel."""
        self._bus.close()

    def read(self, count: int) -> list[Frame]:
        """Return frames that have arrived; see `FrameDevice.read`."""
        self.require(Mode.READ)
        return [Frame(*one) for one in self.ask(self._read, count, default=[])]

    def _read(self, count: int) -> list[tuple[Any, ...]]:
        wait, held = self.opening.wait, self._held
        need = {Wait.ALL: count, Wait.ONE: min(count, 1)}.get(wait, 0)
        while len(held) < count:
            one = self._bus.receive(None if len(held) < need else 0)
            if one is None:
                break
            held.append(_plain(one))
        if wait is Wait.NOALL and len(held) < count:
            return []
        found = held[:count]
        del held[:count]
        return found

    def write(self, frames: Sequence[Frame]) -> int:
        """Hand frames over; see `FrameDevice.write`."""
        self.require(Mode.WRITE)
        for one in frames:
            self.check_piece(one)
        done: int = self.ask(self._write, frames, default=len(frames))
        return done

    def _write(self, frames: Sequence[Frame]) -> int:
        need = {Wait.ALL: len(frames), Wait.ONE: min(len(frames), 1)}
        least, done = need.get(self.opening.wait, 0), 0
        end = math.inf if self.patience is None else time.monotonic() + self.patience
        while done < len(frames):
            if self._give(frames[done]):
                done += 1
            elif done < least:
                if time.monotonic() > end:
                    raise no_room()
                time.sleep(_AGAIN)
            else:
                break
        return done

    def _give(self, one: Frame) -> bool:
        """Hand a frame over; return False if there is no room for it now.

        Raises:
            OSError: The device is gone.
        """
        return self._bus.send(
            one.id,
            one.data,
            is_extended_id=one.extended,
            is_fd=one.fd,
            bitrate_switch=one.fd,
            is_remote_frame=one.remote,
        )

    def check_piece(self, one: Frame) -> None:
        """Refuse a frame that this bus cannot have.

        Raises:
            DeviceError: It cannot.
        """
        largest, fd = _LARGEST_ID[one.extended], self.settings.fd
        expected = [
            (f"an identity of 0 to {largest:X}h", 0 <= one.id <= largest),
            ("a device with `fd = true`", fd or not one.fd),
            ("a remote frame without data", not one.remote or not (one.fd or one.data)),
            (
                "up to 8 bytes; of CAN FD also 12, 16, 20, 24, 32, 48 or 64",
                len(one.data) in (_FD_LENGTHS if one.fd else _LENGTHS),
            ),
        ]
        for text, is_so in expected:
            if not is_so:
                raise DeviceError(
                    "the bus has no such frames",
                    where=f"{self.name} ({self.entry.address})",
                    expected=text,
                    got=f"{one.id:X}h, {len(one.data)} bytes, fd={one.fd}",
                    remedy="see Frame, and [device.NAME.settings] in docs/devices.md",
                )


def _filter(text: str) -> dict[str, Any]:
    """Return an ``ID/MASK`` as python-can has it."""
    identity, _, mask = text.partition("/")
    return {
        "can_id": int(identity, 16),
        "can_mask": int(mask, 16),
        "extended": len(identity) > _STANDARD_DIGITS,
    }


def _plain(one: Any) -> tuple[Any, ...]:  # noqa: ANN401 - a message of python-can
    """Return the values of a `Frame`, as a log has them."""
    return (
        one.arbitration_id,
        bytes(one.data),
        one.is_extended_id,
        one.is_fd,
        one.is_remote_frame,
        round(one.timestamp * 1e9),
    )


def _left(ends: float | None) -> float | None:
    """Return the seconds until then."""
    return None if ends is None else max(0.0, ends - time.monotonic())


def _is_whole(one: Any) -> bool:  # noqa: ANN401 - a message of python-can
    """Return whether a message has an identity and data that there can be."""
    size = 0 if one.is_remote_frame else one.dlc
    largest = _LARGEST_ID[one.is_extended_id]
    return 0 <= one.arbitration_id <= largest and len(one.data) == size


def _check_bus(one: Any) -> None:  # noqa: ANN401 - a message of python-can
    """Return unless an error frame says that the controller has left the bus.

    Raises:
        OSError: It has.
    """
    if one.arbitration_id & _BUS_OFF:
        raise OSError(errno.ENETDOWN, "the controller has left the bus (bus-off)")


def _lost(error: Any) -> OSError:  # noqa: ANN401 - an error of python-can
    number = error.error_code
    return OSError(number or errno.EIO, os.strerror(number) if number else str(error))
