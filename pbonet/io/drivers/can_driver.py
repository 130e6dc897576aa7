"""A CAN bus: class SIO, driver ``can``.

The address is the channel, such as ``can0``. Frames that are not read wait in the
interface; when there is no more room, SocketCAN drops the newest.
"""

from __future__ import annotations

import errno
import math
import os
import socket
import time
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io import from_extra

from .device import Frame, FrameDevice, Settings
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
_AGAIN: Final = 0.001
"""Seconds after which a full interface is tried again."""


class CanSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a CAN bus."""

    interface: str = "socketcan"
    """Interface of python-can."""
    bitrate: int = 0
    """Bits a second; 0: as the interface is set. The system sets SocketCAN's."""
    fd: bool = False
    """Whether frames of CAN FD are sent and received, too."""
    filters: tuple[A[str, Meta(pattern=_FILTER)], ...] = ()
    """``ID/MASK`` in hexadecimal digits: which frames are received; none: all. An
    identity of more than three digits is an extended one."""

    def __post_init__(self) -> None:
        """Refuse a bit rate that nothing would set.

        Raises:
            ValueError: There is one, of SocketCAN.
        """
        if self.bitrate and self.interface == "socketcan":
            raise ValueError(
                "socketcan takes no bitrate: `ip link set can0 type can bitrate N`"
            )


class CanDevice(FrameDevice):
    """A channel of a CAN bus; each opened port is a socket of its own."""

    settings_type: ClassVar[type[Settings]] = CanSettings

    def connect(self) -> None:
        """Open the channel; see `Device.connect`."""
        with from_extra("can", f"the device {self.name}"):
            self._can: Any = import_module("can")
        k = self.settings
        in_kernel = k.interface == "socketcan"
        filters = [_filter(one) for one in k.filters]
        # recv() of python-can stops at each frame that its own filters refuse.
        self._filters = [] if in_kernel else filters
        self._held: list[tuple[Any, ...]] = []
        more: dict[str, Any] = {"fd": True} if k.fd else {}
        if k.bitrate:
            more["bitrate"] = k.bitrate
        if in_kernel and filters:
            more["can_filters"] = filters
        if k.interface == "virtual":
            more["rx_queue_size"] = _ROOM
        try:
            self._bus: Any = self._can.Bus(
                channel=self.entry.address,
                interface=k.interface,
                ignore_config=True,
                **more,
            )
        except (self._can.CanError, *_REFUSALS) as error:
            raise self._unusable(str(error)) from None
        if in_kernel and (
            number := self._bus.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        ):
            self.disconnect()
            raise self._unusable(os.strerror(number))

    def disconnect(self) -> None:
        """Close the channel."""
        with suppress(self._can.CanError, OSError):
            self._bus.shutdown()

    def read(self, count: int) -> list[Frame]:
        """Return frames that have arrived; see `FrameDevice.read`."""
        self.require(Mode.READ)
        return [Frame(*one) for one in self.ask(self._read, count, default=[])]

    def _read(self, count: int) -> list[tuple[Any, ...]]:
        wait, held = self.opening.wait, self._held
        need = {Wait.ALL: count, Wait.ONE: min(count, 1)}.get(wait, 0)
        while len(held) < count:
            try:
                one = self._bus.recv(None if len(held) < need else 0)
            except self._can.CanError as error:
                raise _lost(error) from None
            if one is None:
                break
            if one.is_error_frame:
                _check_bus(one)
            elif self._passes(one):
                held.append(_plain(one))
        if wait is Wait.NOALL and len(held) < count:
            return []
        found = held[:count]
        del held[:count]
        return found

    def _passes(self, one: Any) -> bool:  # noqa: ANN401 - a message of python-can
        """Return whether a filter lets a message pass; the kernel's were before."""
        return not self._filters or any(
            not (one.arbitration_id ^ f["can_id"]) & f["can_mask"]
            and one.is_extended_id == f["extended"]
            for f in self._filters
        )

    def write(self, frames: Sequence[Frame]) -> int:
        """Hand frames over; see `FrameDevice.write`."""
        self.require(Mode.WRITE)
        for one in frames:
            self._check(one)
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
        message = self._can.Message(
            arbitration_id=one.id,
            data=one.data,
            is_extended_id=one.extended,
            is_fd=one.fd,
            bitrate_switch=one.fd,
            is_remote_frame=one.remote,
        )
        try:
            self._bus.send(message, timeout=0)
        except self._can.CanTimeoutError:
            return False
        except self._can.CanError as error:
            # Without a number, these two have no room.
            known = self.settings.interface in {"socketcan", "virtual"}
            full = {errno.ENOBUFS, errno.EAGAIN, *([None] if known else [])}
            if error.error_code in full:
                return False
            raise _lost(error) from None
        return True

    def _check(self, one: Frame) -> None:
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

    def check_safe(self) -> None:
        """Refuse safe frames that this bus cannot have."""
        for one in self.safe:
            self._check(one)

    def _unusable(self, got: str) -> DeviceError:
        return DeviceError(
            "the CAN bus cannot be opened",
            where=f"{self.name} ({self.entry.address})",
            expected="the channel of an interface that is up",
            got=got,
            remedy="check the settings; for SocketCAN: `ip link set can0 up`",
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
