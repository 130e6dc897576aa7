"""Channels for the bytes of a MAVLink link: UDP, TCP or a serial line, never waiting.

An address is one word: ``udpin:HOST:PORT`` and ``tcpin:HOST:PORT`` wait there for
others, ``udpout:HOST:PORT`` and ``tcp:HOST:PORT`` call them, and
``serial:/dev/ttyACM0:57600`` is a line.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import select
import socket
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from pbonet.errors import ParameterError
from pbonet.outside import using

from .serial_line import SerialLine

if TYPE_CHECKING:
    from collections.abc import Callable

    Place = tuple[str, int]
    Read = tuple[bytes, Place | None]
    """The bytes of one read, and their sender, if there may be several."""

LONGEST = 4096
"""Bytes of one read; a MAVLink frame has 293 at most."""
PEERS = 8
"""Other ends that one ``udpin`` sends to; the one heard longest ago makes room."""
_UNSENT = 1 << 16
_BAUD = 57600


class Address(NamedTuple):
    """An address of a link, taken apart."""

    kind: str
    """udpin, udpout, tcp, tcpin or serial."""
    place: str
    """The host's number, or the device file."""
    number: int
    """The port, or bits a second."""

    @property
    def private(self) -> bool:
        """Whether no other machine can reach it: a serial line, or the loopback."""
        return self.kind == "serial" or ipaddress.ip_address(self.place).is_loopback


def parse_address(text: str) -> Address:
    """Return an address taken apart.

    Raises:
        ParameterError: It is not written as one.
    """
    kind, _, rest = text.partition(":")
    place, _, number = rest.rpartition(":")
    if kind == "serial" and rest:
        given = place and number.isdigit()
        return Address(kind, place if given else rest, int(number) if given else _BAUD)
    host = "127.0.0.1" if place == "localhost" else place
    try:
        ipaddress.IPv4Address(host)
        port = int(number)
    except ValueError:
        port = 0
    if kind not in CHANNELS or not 0 < port < 1 << 16:
        raise ParameterError(
            "this is no address of a MAVLink link",
            expected="udpin:, udpout:, tcp: or tcpin:HOST:PORT with the number of a "
            "host or localhost, or serial:DEVICE:BAUD",
            got=text,
            remedy="correct ADDRESS, as in udpin:localhost:14550",
        )
    return Address(kind, host, port)


class Channel(Protocol):
    """Moves bytes; a `DeviceError` or another `OSError` says that it is lost."""

    whole: bool
    """Whether a frame never spans two reads."""

    def open(self) -> None:
        """Begin."""

    def receive(self, most: int) -> list[Read]:
        """Return what is there, by at most so many reads.

        A loss is raised when nothing is left to return.
        """
        ...

    def accept(self, sender: Place | None) -> None:
        """Send to the sender of a read, too."""

    def send(self, data: bytes) -> bool:
        """Send one frame; False: there is no room for it, or no other end."""
        ...

    def wait(self, seconds: float) -> None:
        """Wait until something is there; for `init` alone."""

    def close(self) -> None:
        """End; allowed twice."""


class _Socket:
    """The socket of a channel."""

    def __init__(self, address: Address) -> None:
        self._address = address
        self._place: Place = (address.place, address.number)
        self._socket: socket.socket | None = None

    def _make(self, kind: socket.SocketKind) -> socket.socket:
        self.close()
        self._socket = made = socket.socket(socket.AF_INET, kind)
        made.settimeout(0.0)
        return made

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise OSError(errno.EBADF, "the link is closed")
        return self._socket

    def wait(self, seconds: float) -> None:
        """Wait until something is there."""
        select.select([self._open_socket()], [], [], seconds)

    def close(self) -> None:
        """End."""
        made, self._socket = self._socket, None
        if made is not None:
            made.close()


class UdpChannel(_Socket):
    """Datagrams, each with whole frames."""

    whole = True

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self._peers: dict[Place, None] = {}
        self._accepted: Place | None = None

    def open(self) -> None:
        """Take the port, or call the other end."""
        made = self._make(socket.SOCK_DGRAM)
        self._peers.clear()
        self._accepted = None
        if self._address.kind == "udpin":
            made.bind(self._place)
        else:
            made.connect(self._place)

    def receive(self, most: int) -> list[Read]:
        """Return the next datagrams, which may be empty."""
        made, found = self._open_socket(), list["Read"]()
        try:
            if self._address.kind == "udpout":  # the sender is known: that is faster
                while len(found) < most:
                    found.append((made.recv(LONGEST), None))
            while len(found) < most:
                found.append(made.recvfrom(LONGEST))
        except (BlockingIOError, ConnectionRefusedError):  # the latter: not there yet
            pass
        return found

    def accept(self, sender: Place | None) -> None:
        """Send to the sender of a datagram, too."""
        if sender is None or sender == self._accepted:
            return
        self._accepted = sender
        self._peers.pop(sender, None)
        self._peers[sender] = None
        if len(self._peers) > PEERS:
            del self._peers[next(iter(self._peers))]

    def send(self, data: bytes) -> bool:
        """Send a datagram to each other end."""
        made, sent = self._open_socket(), False
        try:
            if self._address.kind == "udpout":
                sent = made.send(data) > 0
            for peer in self._peers:
                sent = made.sendto(data, peer) > 0 or sent
        except (BlockingIOError, ConnectionRefusedError):
            return sent
        return sent


def _pieces(read: Callable[[], bytes], most: int) -> list[Read]:
    """Return the pieces of a stream that are there.

    A loss is raised by the next call when something came before it.
    """
    found = list["Read"]()
    try:
        while len(found) < most and (data := read()):
            found.append((data, None))
    except OSError:
        if not found:
            raise
    return found


class TcpChannel(_Socket):
    """A stream to a server."""

    whole = False

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self._unsent = b""

    def open(self) -> None:
        """Begin to connect."""
        made = self._make(socket.SOCK_STREAM)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._unsent = b""
        code = made.connect_ex(self._place)
        if code not in {0, errno.EINPROGRESS}:
            raise OSError(code, os.strerror(code))

    def receive(self, most: int) -> list[Read]:
        """Return what has arrived."""
        return _pieces(self._piece, most)

    def _piece(self) -> bytes:
        try:
            data = self._open_socket().recv(LONGEST)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.ECONNRESET, "the other end has closed the connection")
        return data

    def accept(self, sender: Place | None) -> None:
        """There is one other end."""

    def send(self, data: bytes) -> bool:
        """Send a frame whole, now or with the next one."""
        if len(self._unsent) + len(data) > _UNSENT:
            return False
        self._unsent += data
        try:
            self._unsent = self._unsent[self._open_socket().send(self._unsent) :]
        except BlockingIOError:  # also: not connected yet
            return True
        return True


class TcpServerChannel(TcpChannel):
    """A stream to the client that connects first."""

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self._door: socket.socket | None = None

    def open(self) -> None:
        """Take the port, and wait for a client."""
        self.close()
        self._unsent = b""
        self._door = made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        made.settimeout(0.0)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(self._place)
        made.listen(1)

    def receive(self, most: int) -> list[Read]:
        """Return what has arrived."""
        return super().receive(most) if self._connected() else []

    def send(self, data: bytes) -> bool:
        """Send a frame whole, now or with the next one; False without a client."""
        return self._connected() and super().send(data)

    def wait(self, seconds: float) -> None:
        """Wait until something is there."""
        if self._connected():
            super().wait(seconds)
        elif self._door is not None:
            select.select([self._door], [], [], seconds)

    def close(self) -> None:
        """End."""
        super().close()
        door, self._door = self._door, None
        if door is not None:
            door.close()

    def _connected(self) -> bool:
        """Return whether a client is there, once it has connected."""
        if self._socket is None and self._door is not None:
            try:
                self._socket, _ = self._door.accept()
            except BlockingIOError:
                return False
            self._socket.settimeout(0.0)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._socket is not None


class SerialChannel:
    """A serial line."""

    whole = False

    def __init__(self, address: Address) -> None:
        with using(None):  # the link itself records what it reads
            self._line = SerialLine(address.place, address.number)
        self._unsent = b""

    def open(self) -> None:
        """Open and configure the line."""
        self._line.open()
        self._unsent = b""

    def receive(self, most: int) -> list[Read]:
        """Return what has arrived."""
        return _pieces(lambda: self._line.read_available(LONGEST), most)

    def accept(self, sender: Place | None) -> None:
        """There is one other end."""

    def send(self, data: bytes) -> bool:
        """Send a frame whole, now or with the next one."""
        if len(self._unsent) + len(data) > _UNSENT:
            return False
        self._unsent += data
        self._unsent = self._unsent[self._line.write_nowait(self._unsent) :]
        return True

    def wait(self, seconds: float) -> None:
        """Wait until something is there."""
        self._line.wait(seconds)

    def close(self) -> None:
        """End."""
        self._line.close()


CHANNELS: Final[dict[str, type[UdpChannel | TcpChannel]]] = {
    "udpin": UdpChannel,
    "udpout": UdpChannel,
    "tcp": TcpChannel,
    "tcpin": TcpServerChannel,
}
"""The channel of each kind of address with a host."""


def make_channel(address: Address) -> Channel:
    """Return the channel of an address; it is not open."""
    made = CHANNELS.get(address.kind)
    return SerialChannel(address) if made is None else made(address)
