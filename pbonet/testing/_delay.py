"""A cable that delays: frames wait in a process's memory between two devices.

A second pair of virtual devices is laid beside each end of a cable, and the hosts send
to each other over those. Frames from one are sent to the other, later and in order.
Nothing is lost, and existing links continue. The kernel's own delay (netem) is not in
every kernel; this needs only what cables need.
"""

from __future__ import annotations

import ctypes
import pathlib
import select
import socket
import threading
import time
from collections import deque
from typing import Final

_ALL: Final = 0x0003
_PACKET, _HEADERS, _OUTGOING = 263, 15, 4
_LARGEST: Final = 1 << 17
_CLONE_NEWNET: Final = 0x40000000


class Delay:
    """Carries frames between two devices, each way, until it is closed.

    Args:
        space: The network namespace in which both devices are.
        devices: Their names.
        seconds: By how much each frame is late.
    """

    def __init__(self, space: str, devices: tuple[str, str], seconds: float) -> None:
        self._seconds = seconds
        self._ends: list[socket.socket] = []
        self._open(space, devices)
        self._over, self._bell = socket.socketpair()
        self._thread = threading.Thread(
            target=self._work, name="slow cable", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop; frames in transit are lost."""
        self._bell.close()
        self._thread.join()
        for end in (self._over, *self._ends):
            end.close()

    def _open(self, space: str, devices: tuple[str, str]) -> None:
        """Open a socket on each device, from a thread that goes to where they are."""
        failed: list[OSError] = []

        def there() -> None:
            try:
                with pathlib.Path(f"/run/netns/{space}").open("rb") as file:
                    _enter(file.fileno())
                for device in devices:
                    end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
                    self._ends.append(end)
                    # Frames come with what is left to do for them, and go with it.
                    end.setsockopt(_PACKET, _HEADERS, 1)
                    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
                    end.bind((device, _ALL))
                    end.settimeout(0.0)
            except OSError as error:
                failed.append(error)

        thread = threading.Thread(target=there)
        thread.start()
        thread.join()
        if failed:
            for end in self._ends:
                end.close()
            raise failed[0]

    def _work(self) -> None:
        late: deque[tuple[float, socket.socket, bytes]] = deque()
        other = dict(zip(self._ends, reversed(self._ends), strict=True))
        while True:
            wait = max(late[0][0] - time.monotonic(), 0.0) if late else None
            ready, _, _ = select.select([self._over, *self._ends], [], [], wait)
            if self._over in ready:
                return
            now = time.monotonic()
            for end in ready:
                late.extend(
                    (now + self._seconds, other[end], frame) for frame in _frames(end)
                )
            while late and late[0][0] <= now:
                _, end, frame = late.popleft()
                try:
                    end.send(frame)
                except OSError:  # no room: a frame is lost, as on any cable
                    continue


def _enter(space: int) -> None:
    """Take this thread into another network."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(space, _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "no way into the network namespace")


def _frames(end: socket.socket) -> list[bytes]:
    """Return the frames that have come out of a device."""
    found: list[bytes] = []
    while True:
        try:
            frame, where = end.recvfrom(_LARGEST)
        except BlockingIOError:
            return found
        except OSError:  # the device is going away
            return found
        if where[2] != _OUTGOING:
            found.append(frame)


__all__ = ["Delay"]
