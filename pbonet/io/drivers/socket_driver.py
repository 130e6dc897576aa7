"""A line over TCP or UDP: class SIO, drivers ``tcp`` and ``udp``.

The address is HOST:PORT. A datagram of UDP is one piece: `write` sends one, and bytes
of several are read one after the other.
"""

from __future__ import annotations

import errno
import socket
from typing import ClassVar

from pbonet.errors import DeviceError

from .device import Settings, StreamDevice
from .modes import Mode
from .stream_waits import read_all, write_all

_DATAGRAM = 65536


class SocketSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a line over a network."""

    timeout: float = 2.0
    """Seconds in which a TCP connection is made."""
    listen: int = 0
    """The port on which datagrams of UDP arrive; 0: any."""


class _SocketDevice(StreamDevice):
    """A device at one connected socket."""

    settings_type: ClassVar[type[Settings]] = SocketSettings
    _socket: socket.socket

    def connect(self) -> None:
        """Open the line; see `Device.connect`."""
        host, _, port = self.entry.address.rpartition(":")
        self._held = bytearray()
        try:
            self._socket = self.made(host.strip("[]"), int(port))
        except (OSError, ValueError, OverflowError) as error:
            raise DeviceError(
                "the line cannot be opened",
                where=f"{self.name} ({self.entry.address})",
                expected="HOST:PORT of a device that answers",
                got=str(error),
                remedy="check the address, and that the device is switched on",
            ) from None
        self._socket.setblocking(False)  # noqa: FBT003

    def made(self, host: str, port: int) -> socket.socket:
        """Return a socket that is connected with the device."""
        raise NotImplementedError

    def taken(self, limit: int) -> bytes:
        """Return bytes that have arrived; empty if none has."""
        raise NotImplementedError

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
        return write_all(self._socket.fileno(), self._give, data, self.opening.wait)

    def _give(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0


class TcpDevice(_SocketDevice):
    """A TCP connection to a device."""

    def made(self, host: str, port: int) -> socket.socket:
        """Return a connection."""
        one = socket.create_connection((host, port), self.settings.timeout)
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return one

    def taken(self, limit: int) -> bytes:
        """Return bytes that have arrived."""
        try:
            data = self._socket.recv(limit)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.ECONNRESET, "the other end has closed the connection")
        return data


class UdpDevice(_SocketDevice):
    """Datagrams to and from one device."""

    def made(self, host: str, port: int) -> socket.socket:
        """Return a socket for datagrams to and from that address."""
        (family, kind, protocol, _, where), *_ = socket.getaddrinfo(
            host, port, type=socket.SOCK_DGRAM
        )
        one = socket.socket(family, kind, protocol)
        try:
            if self.settings.listen:
                one.bind(("", self.settings.listen))
            one.connect(where)
        except BaseException:
            one.close()
            raise
        return one

    def taken(self, limit: int) -> bytes:
        """Return one datagram; what does not fit is kept by the caller."""
        del limit
        try:
            return self._socket.recv(_DATAGRAM)
        except BlockingIOError:
            return b""
        except ConnectionRefusedError:
            return b""  # no program listens there yet: no loss of the line
