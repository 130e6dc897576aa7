"""A line that carries requests and their answers, one request at a time.

`begin` hands a request over, `answer` returns what has come. Neither waits; `wait`
does.
"""

from __future__ import annotations

import select
from abc import ABC, abstractmethod
from time import monotonic
from typing import Final, Generic, TypeVar

from pbonet.errors import DeviceError

R = TypeVar("R")
"""A request of a protocol."""
AT_ONCE: Final = 4096
"""Bytes taken at once: more than any frame has."""


class Line(ABC, Generic[R]):
    """A line to one device.

    Args:
        timeout: Seconds in which it answers.
        where: For errors.
    """

    def __init__(self, timeout: float, where: str) -> None:
        self.timeout, self.where = timeout, where
        self._in = bytearray()
        self._out = b""
        self.ends = 0.0
        """When the answer is late."""

    def begin(self, request: R) -> None:
        """Hand a request over.

        Raises:
            OSError: The device is gone.
        """
        self._request = request
        self._out = self.framed(request)
        self.ends = monotonic() + self.timeout
        self.push()

    def push(self) -> None:
        """Hand over what is left of the request.

        Raises:
            OSError: The device is gone.
        """
        if self._out:
            self._out = self._out[self.give(self._out) :]

    def answer(self) -> bytes | None:
        """Return the answer to the request; None: it has not come yet.

        Raises:
            DeviceError: None came in time, or it is damaged.
            OSError: The device is gone, or does not talk this protocol.
        """
        self.push()
        self._in += self.taken()
        found = self.unframed(self._request)
        if found is None and monotonic() >= self.ends:
            raise DeviceError(
                "the device does not answer",
                where=self.where,
                expected=f"an answer within {self.timeout:g} s",
                got=self.come(),
                remedy="check that it is switched on, its wires, and its number and "
                "the line's settings in agent.toml",
            )
        return found

    def come(self) -> str:
        """Return what has come of an answer that is late, for errors."""
        return self._in[:16].hex(" ") or "nothing"

    def wait(self) -> None:
        """Wait for more bytes, at most until the answer is late."""
        fd, left = self.fileno(), max(0.0, self.ends - monotonic())
        select.select([fd], [fd] if self._out else [], [], left)

    @abstractmethod
    def fileno(self) -> int:
        """Return the descriptor."""

    @abstractmethod
    def close(self) -> None:
        """Close the line."""

    @abstractmethod
    def give(self, data: bytes) -> int:
        """Hand bytes over; return how many were taken."""

    @abstractmethod
    def taken(self) -> bytes:
        """Return bytes that have come."""

    @abstractmethod
    def framed(self, request: R) -> bytes:
        """Return a request as the line carries it."""

    @abstractmethod
    def unframed(self, request: R) -> bytes | None:
        """Return the answer out of the bytes that came; None: it is not whole."""
