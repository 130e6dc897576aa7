"""Makes TCP retry soon after an interruption, so that links survive it.

TCP doubles its pause with each retransmission that is not acknowledged: after a cut of
0.7 s the next one may come 0.6 s later. The kernel has no setting against that, but its
limit `TCP_USER_TIMEOUT`, after which a connection ends, also shortens the pause that
would exceed it. So while a connection retransmits, the limit is kept a moment ahead of
now: then the kernel retransmits at that moment, and the limit is moved on before that.

A connection that confirms nothing for twice as long as a silent link is kept is shut
down. zenoh writes out what waits before it closes a TLS link, and would do so until
the cable is plugged in again, with the lost agent in sight all the time.

To close a connection waits for nothing. zenoh sets `SO_LINGER`, by which the thread
that closes a lost link waits up to ten seconds for what the other side has not
confirmed. It is often the only one that accepts new links, or that sends. The option
is taken off each time: zenoh sets it after the greeting of TLS, which may come later.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import stat
import struct
import time
from typing import TYPE_CHECKING

from pbonet.xm.net import session, so_linger

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

AHEAD_MS = 100
"""Longest pause between two retransmissions. An agent that stands still for longer
during an interruption loses the link, and makes it again."""
BUSY = 0.025
"""Seconds between checks while something is being sent again."""
IDLE = 0.1
"""The same otherwise: the first retransmission is seen before the second one, which
comes 0.15 s later."""
NEVER = math.inf
"""The same without a connection."""
FIRST_US = 75_000
"""Until the first retransmission, in addition to the measured round trip. It exceeds
the 40 ms by which a receiver may delay an acknowledgement."""
UNSENT = 8192
"""Bytes that wait in a socket: what is written during an interruption is old at its
end, and would be sent before all that is new. The kernel appends small packets to the
last buffer without asking for this limit, up to 64 kB."""
GIVEN_UP = 2
"""Times the lease of a link: zenoh itself has given it up before, or tries to."""
_RTO_MIN_US = 45
"""The option for it, since Linux 6.15; else it is 200 ms, or `rto_min` of the route."""
_INFO = struct.Struct("4B4xI24xI4xI8xI40xI")
"""Of `TCP_INFO`: state, congestion state, time-outs without an acknowledgement, probes,
time-out in us, segments that are sent again, ms since the last sending and since the
last confirmation, and how many segments were ever sent again."""
_ESTABLISHED = 1
_OPEN = 0


class Connection:
    """One TCP connection of this process.

    Args:
        fd: Its file descriptor.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._whole = time.monotonic()
        """When nothing was being sent again."""
        self._ever: int = 0
        """How many segments had been sent again then."""
        self._limited = False
        self.is_busy = False
        """Whether it sends something again, or could not send."""
        with contextlib.suppress(OSError), _opened(fd) as one:
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
            one.setsockopt(socket.IPPROTO_TCP, _RTO_MIN_US, FIRST_US)

    def tend(self, now: float) -> bool:
        """Set the limit, or end it; return whether this is still a connection.

        Args:
            now: `time.monotonic()`.
        """
        try:
            with _opened(self._fd) as one:
                self._limit(one, now)
        except OSError:
            return False
        return True

    def _limit(self, one: socket.socket, now: float) -> None:
        data = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO.size)
        (state, congestion, again, probes, pause_us, sent, ago_ms, silent_ms, ever) = (
            _INFO.unpack(data)
        )
        if state != _ESTABLISHED:
            raise OSError
        self.is_busy = bool(again or probes)
        if self.is_busy and silent_ms > GIVEN_UP * session.LEASE_MS:
            one.shutdown(socket.SHUT_RDWR)
            raise OSError
        if probes:  # nothing could be sent, as while a device is down: try it now
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if again:
            if not (sent or self._limited):  # the kernel counts from the first sending
                self._whole -= pause_us * 1e-6
            elif again == 1 and not self._limited:  # it counts from this one
                self._whole = max(self._whole, now - ago_ms * 1e-3)
            _set_limit(one, round((now - self._whole) * 1e3) + AHEAD_MS)
            self._limited = True
            return
        if congestion == _OPEN or ever == self._ever:
            self._whole, self._ever = now, int(ever)
        if self._limited:
            _set_limit(one, 0)
            self._limited = False


class Retransmission:
    """All TCP connections of this process."""

    def __init__(self) -> None:
        self._connections: dict[tuple[int, int], Connection] = {}
        """By file descriptor and inode: a new one often has the number of the last."""

    def find(self) -> None:
        """Find the connections; to be called when there may be others."""
        found = set(_connected())
        for key in self._connections.keys() - found:
            del self._connections[key]
        for key in found - self._connections.keys():
            self._connections[key] = Connection(key[0])

    def tend(self) -> float:
        """Shorten the pauses; return the seconds until this is to be called again."""
        now = time.monotonic()
        for key, one in list(self._connections.items()):
            if not one.tend(now):
                del self._connections[key]
        if not self._connections:
            return NEVER
        busy = any(one.is_busy for one in self._connections.values())
        return BUSY if busy else IDLE


@contextlib.contextmanager
def _opened(fd: int) -> Generator[socket.socket]:
    """Return the socket of a file descriptor, which stays open.

    Raises:
        OSError: It is none.
    """
    one = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, fileno=fd)
    try:
        yield one
    finally:
        one.detach()


def _set_limit(one: socket.socket, milliseconds: int) -> None:
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, milliseconds)


def _connected() -> Iterator[tuple[int, int]]:
    """Yield the established TCP connections of this process; closing one takes no time.

    Each is given by its file descriptor and its inode.
    """
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - numbers, no paths
        fd = int(name)
        with contextlib.suppress(OSError):
            found = os.fstat(fd)
            if not stat.S_ISSOCK(found.st_mode):
                continue
            with _opened(fd) as one:
                data = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO.size)
                if data[0] != _ESTABLISHED:
                    continue
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, so_linger.NEVER)
            yield fd, found.st_ino
