"""Sockets of the network that never wait: of TCP, connected within a time."""

from __future__ import annotations

import errno
import socket

from pbonet.errors import DeviceError


def connect(address: str, timeout: float, where: str) -> socket.socket:
    """Return a connection to HOST:PORT, non-blocking and without delay.

    Args:
        address: HOST:PORT; an address of IPv6 in brackets.
        timeout: Seconds in which it is made.
        where: For errors.

    Raises:
        DeviceError: The address is wrong, or nothing answers there.
    """
    host, _, port = address.rpartition(":")
    try:
        made = socket.create_connection((host.strip("[]"), int(port)), timeout)
    except (OSError, ValueError, OverflowError) as error:
        raise unreachable(where, error) from None
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    made.setblocking(False)  # noqa: FBT003
    return made


def receive(connection: socket.socket, limit: int) -> bytes:
    """Return bytes that have arrived; empty if none has.

    Raises:
        OSError: The connection is lost, or was closed by the other end.
    """
    try:
        data = connection.recv(limit)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError(errno.ECONNRESET, "the other end has closed the connection")
    return data


def send(connection: socket.socket, data: bytes) -> int:
    """Hand over what there is room for; return how many bytes.

    Raises:
        OSError: The connection is lost.
    """
    try:
        return connection.send(data)
    except BlockingIOError:
        return 0


def unreachable(where: str, error: Exception) -> DeviceError:
    """Return the error for an address at which nothing answers."""
    return DeviceError(
        "the device cannot be reached",
        where=where,
        expected="HOST:PORT of a device that answers",
        got=str(error),
        remedy="check the address, and that the device is switched on",
    )
