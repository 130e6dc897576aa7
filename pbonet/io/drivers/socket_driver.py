"""A line over TCP or UDP: class SIO, drivers ``tcp`` and ``udp``.

The address is HOST:PORT. A datagram of UDP is one piece: `write` sends one, and bytes
of several are read one after the other.
"""

from __future__ import annotations

import socket
from abc import abstractmethod
from typing import ClassVar

from . import inet_sockets
from .device import Settings
from .device_classes import StreamDevice
from .modes import Mode
from .stream_waits import read_all, write_all

_DATAGRAM = 65536


class _SocketDevice(StreamDevice):
    """A device at one connected socket."""

    _socket: socket.socket

    def connect(self) -> None:
        """Open the line; see `Device.connect`."""
        self._held = bytearray()
        self._socket = self.made(f"{self.name} ({self.entry.address})")

    @abstractmethod
    def made(self, where: str) -> socket.socket:
        """Return a non-blocking socket that is connected with the device.

        Raises:
            DeviceError: The device cannot be reached.
        """

    @abstractmethod
    def taken(self, limit: int) -> bytes:
        """Return bytes that have arrived; empty if none has."""

    @abstractmethod
    def give(self, data: bytes) -> int:
        """Hand bytes over; return how many were taken."""

    def disconnect(self) -> None:
        """Close the line."""
        self._socket.close()

    def read(self, count: int) -> bytes:
        """Return bytes that have arrived; see `StreamDevice.read`."""
        self.require(Mode.READ)
        data: bytes = self.ask(self._read, count, default=b"")
        return data

    def _read(self, count: int) -> bytes:
        one = self._socket
        return read_all(one.fileno(), self.taken, count, self.opening.wait, self._held)

    def write(self, data: bytes) -> int:
        """Hand bytes over; see `StreamDevice.write`."""
        self.require(Mode.WRITE)
        done: int = self.ask(self._write, data, default=len(data))
        return done

    def _write(self, data: bytes) -> int:
        one, wait = self._socket, self.opening.wait
        return write_all(one.fileno(), self.give, data, wait, self.patience)


class TcpSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a line over TCP."""

    timeout: float = 2.0
    """Seconds in which the connection is made."""


class TcpDevice(_SocketDevice):
    """A TCP connection to a device."""

    settings_type: ClassVar[type[Settings]] = TcpSettings

    def made(self, where: str) -> socket.socket:
        """Return a connection."""
        return inet_sockets.connect(self.entry.address, self.settings.timeout, where)

    def taken(self, limit: int) -> bytes:
        """Return bytes that have arrived."""
        return inet_sockets.receive(self._socket, limit)

    def give(self, data: bytes) -> int:
        """Hand bytes over; return how many were taken."""
        return inet_sockets.send(self._socket, data)


class UdpSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a line over UDP."""

    listen: int = 0
    """The port on which datagrams arrive; 0: any."""


class UdpDevice(_SocketDevice):
    """Datagrams to and from one device.

    That no program listens there yet is no loss of the line.
    """

    settings_type: ClassVar[type[Settings]] = UdpSettings

    def made(self, where: str) -> socket.socket:
        """Return a socket for datagrams to and from that address."""
        host, _, port = self.entry.address.rpartition(":")
        try:
            (family, kind, protocol, _, there), *_ = socket.getaddrinfo(
                host.strip("[]"), int(port), type=socket.SOCK_DGRAM
            )
            one = socket.socket(family, kind | socket.SOCK_NONBLOCK, protocol)
        except (OSError, ValueError, OverflowError) as error:
            raise inet_sockets.unreachable(where, error) from None
        try:
            if self.settings.listen:
                one.bind(("", self.settings.listen))
            one.connect(there)
        except (OSError, OverflowError) as error:
            one.close()
            raise inet_sockets.unreachable(where, error) from None
        return one

    def taken(self, limit: int) -> bytes:
        """Return one datagram; what does not fit is kept by the caller."""
        del limit
        try:
            return self._socket.recv(_DATAGRAM)
        except (BlockingIOError, ConnectionRefusedError):
            return b""

    def give(self, data: bytes) -> int:
        """Send one datagram; return its length, or 0 if there is no room."""
        try:
            return inet_sockets.send(self._socket, data)
        except ConnectionRefusedError:  # of an earlier one; the kernel says it once
            return inet_sockets.send(self._socket, data)
