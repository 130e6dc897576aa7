"""Serial lines that devices of one task share, with a request at a time.

Each request has its turn, in the order in which they began. A second process cannot
open the line.
"""

from __future__ import annotations

import select
from collections import deque
from time import monotonic
from typing import Any, Final

from pbonet.errors import DeviceError
from pbonet.io import SerialPort

from .request_device import AT_ONCE, Line, R


class _Bus:
    """A serial line of this process, with the requests that have their turn on it."""

    def __init__(self, path: str, settings: dict[str, Any]) -> None:
        self.port, self.settings = SerialPort(path, **settings), settings
        self.port.open()
        self.free_at = 0.0
        """When the silence after the last frame has been long enough."""
        self.turns: deque[SharedLine[Any]] = deque()
        self.users = 0

    def has_hung_up(self) -> bool:
        """Return whether the line's device was unplugged."""
        poll = select.poll()
        poll.register(self.port.fileno(), 0)
        return bool(poll.poll(0))

    def has(self, line: SharedLine[Any]) -> bool:
        """Return whether it is a request's turn."""
        while self.turns and self.turns[0] is not line:
            if not self.turns[0].is_over():
                return False
            self.turns.popleft()
        return bool(self.turns)


_buses: Final[dict[str, _Bus]] = {}


class SharedLine(Line[R]):
    """The line to one device.

    Args:
        path: The device file.
        settings: Of the serial line: baud, parity, stop.
        timeout: Seconds in which it answers, its wait for a turn included.
        where: For errors.

    Raises:
        DeviceError: The serial line cannot be opened, or is open with other settings.
    """

    gap: float = 0.0
    """Seconds of silence that follow a frame."""

    def __init__(
        self, path: str, settings: dict[str, Any], timeout: float, where: str
    ) -> None:
        super().__init__(timeout, where)
        bus = _buses.get(path)
        if bus is not None and bus.has_hung_up():
            bus = None
        if bus is not None and bus.settings != settings:
            raise DeviceError(
                "the device cannot be reached so",
                where=where,
                expected=str(bus.settings),
                got=str(settings),
                remedy="give all devices of a serial line the same baud, parity and "
                "stop",
            )
        if bus is None:
            bus = _buses[path] = _Bus(path, settings)
        bus.users += 1
        self._path, self._bus = path, bus
        self._sent = False
        """Whether its turn has begun."""

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._bus.port.fileno()

    def close(self) -> None:
        """Give the serial line up; the last one closes it."""
        self._leave()
        self._bus.users -= 1
        if not self._bus.users:
            self._bus.port.close()
            if _buses.get(self._path) is self._bus:
                del _buses[self._path]

    def begin(self, request: R) -> None:
        """Hand a request over as soon as it has its turn."""
        self._leave()
        self._bus.turns.append(self)
        self._sent = False
        self._in.clear()
        super().begin(request)

    def answer(self) -> bytes | None:
        """Return the answer, which ends the turn; see `Line.answer`."""
        try:
            found = super().answer()
        except OSError:
            self._leave()
            raise
        if found is not None:
            self._leave()
        return found

    def wait(self) -> None:
        """Wait for more bytes, or for the silence after another frame."""
        left = self._bus.free_at - monotonic()
        if self._out and left > 0:
            select.select([], [], [], left)
        elif self._out and not self._bus.has(self):
            select.select([self.fileno()], [], [], max(0.0, self.ends - monotonic()))
        else:
            super().wait()

    def is_over(self) -> bool:
        """Go on with the request; return whether its turn has ended, well or not.

        Raises:
            OSError: The line is gone.
        """
        self.push()
        self._in.extend(self.taken())
        try:
            whole = self._sent and self.unframed(self._request) is not None
        except DeviceError:
            return True
        return whole or monotonic() >= self.ends

    def give(self, data: bytes) -> int:
        """Hand bytes over in turn; return how many were taken."""
        if not self._sent:
            if not self._bus.has(self) or monotonic() < self._bus.free_at:
                return 0
            self._bus.port.discard()  # what comes before the request is no answer
            self._sent = True
        if self not in self._bus.turns:
            return 0  # it was too late
        return self._bus.port.write(data)

    def taken(self) -> bytes:
        """Return bytes that have come, in turn."""
        if not self._sent or self not in self._bus.turns:
            return b""
        data = self._bus.port.read(AT_ONCE)
        if data:
            self._bus.free_at = monotonic() + self.gap
        return data

    def _leave(self) -> None:
        """End the turn, where there is one."""
        if self in self._bus.turns:
            self._bus.turns.remove(self)
