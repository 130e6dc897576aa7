"""Devices that are asked by requests over a line, and answer them; and such lines.

A line carries one request at a time: `begin` hands it over, `answer` returns what has
come. Neither waits; `wait` does.

With `Wait.ALL` a call waits for the device, at most for the setting `timeout` for each
request: this is for synchronous tasks. With `Wait.NONE` no call waits, for periodic
tasks: a `read` returns what answered the request of a call before it, or nothing, and
makes the next request; a `write` makes a request, or keeps the newest values until the
device has answered the one before. What is wrong with an answer is raised by a later
call. `close` waits until the device has taken what was written last, or `timeout` is
over.
"""

from __future__ import annotations

import select
from abc import ABC, abstractmethod
from contextlib import suppress
from time import monotonic
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from pbonet.errors import DeviceError

from .device_classes import PortDevice
from .modes import Wait

if TYPE_CHECKING:
    from collections.abc import Sequence

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
        if found is None and self.is_late:
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

    @property
    def is_late(self) -> bool:
        """Whether the time is over in which the request is answered."""
        return monotonic() >= self.ends

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


class RequestDevice(PortDevice, Generic[R]):
    """Ports behind requests of a protocol."""

    waits = frozenset({Wait.ALL, Wait.NONE})

    def connect(self) -> None:
        """Open the line; see `Device.connect`."""
        self._line = self.make_line()
        self._reads = self.requests_to_read()
        self._job: Sequence[R] = ()
        """The requests that are under way; the last one that began has no answer."""
        self._answers: list[bytes] = []
        self._writes = False
        """Whether that job, or the last one, writes."""
        self._wanted = False
        """Whether values are read, without waiting."""
        self._values: list[int] | None = None
        self._next: Sequence[int] | None = None
        """Values that are written next."""

    @abstractmethod
    def make_line(self) -> Line[R]:
        """Return the line to the device.

        Raises:
            DeviceError: It cannot be opened.
        """

    @abstractmethod
    def requests_to_read(self) -> Sequence[R]:
        """Return the requests that read the opened ports."""

    @abstractmethod
    def requests_to_write(self, values: Sequence[int]) -> Sequence[R]:
        """Return the requests that write the opened ports."""

    def requests_one_by_one(self, values: Sequence[int]) -> Sequence[R]:
        """Return requests that write the opened ports, each refused for itself alone.

        Here: those of `requests_to_write`, for a protocol that joins no ports.
        """
        return self.requests_to_write(values)

    @abstractmethod
    def check(self, request: R, answer: bytes) -> None:
        """Return if the device did what it was asked for.

        Raises:
            DeviceError: It refuses, or answers something else.
        """

    @abstractmethod
    def values_of(self, answers: Sequence[tuple[R, bytes]]) -> list[int]:
        """Return the values that the answers to all requests have."""

    def disconnect(self) -> None:
        """Close the connection, when the device has what was written last."""
        self._wanted = False
        with suppress(OSError):
            while self._next is not None or (self._job and self._writes):
                self._go_on()
                if self._job:
                    self._line.wait()
        self._line.close()

    def read_ports(self) -> Sequence[int] | None:
        """Return the opened ports' values; None: no new ones have come."""
        if self.opening.wait is Wait.NONE:
            self._wanted = True
            self._go_on()
        else:
            self._begin(self._reads, writes=False)
            self._finish()
        values, self._values = self._values, None
        return values

    def write_ports(self, values: Sequence[int]) -> None:
        """Write the opened ports' values."""
        if self.opening.wait is Wait.NONE:
            self._next = values
            self._go_on()
        else:
            self._next = None
            with suppress(OSError):  # of a request that did not wait
                self._finish()
            self._begin(self.requests_to_write(values), writes=True)
            self._finish()

    def _write_safe(self) -> None:
        """Write the safe values; what the device refuses keeps no other from it."""
        try:
            super()._write_safe()
        except DeviceError:
            if self.opening.wait is Wait.NONE or not self._is_open:
                raise
            raw = self.raw_of(self.safe)
            self.ask(self._write_one_by_one, raw, default=None)

    def _write_one_by_one(self, values: Sequence[int]) -> None:
        """Write values that were refused together; raise the first error at the end.

        Raises:
            DeviceError: The device refuses one, or does not answer: then all that
                follow are left out, for each would take as long.
            OSError: The device is gone.
        """
        first: DeviceError | None = None
        for request in self.requests_one_by_one(values):
            try:
                self.request_now([request])
            except DeviceError as error:
                first = first or error
                if self._line.is_late:
                    break
        if first is not None:
            raise first

    def request_now(self, job: Sequence[R]) -> list[tuple[R, bytes]]:
        """Return the answers to requests, and wait for them; not in a cycle.

        Raises:
            DeviceError: The device refuses, or does not answer.
            OSError: The device is gone.
        """
        self._begin(job, writes=True)
        self._finish()
        return list(zip(job, self._answers, strict=True))

    def _begin(self, job: Sequence[R], *, writes: bool) -> None:
        self._job, self._writes = job, writes
        self._answers = []
        self._line.begin(job[0])

    def _finish(self) -> None:
        """Wait until the job has ended."""
        while self._step():
            self._line.wait()

    def _go_on(self) -> None:
        """Take what has come, and begin the next job; reads and writes take turns."""
        if self._step():
            return
        values = self._next
        if values is not None and not (self._writes and self._wanted):
            self._next = None
            self._begin(self.requests_to_write(values), writes=True)
        elif self._wanted:
            self._begin(self._reads, writes=False)

    def _step(self) -> bool:
        """Take the answers that have come; return whether some are missing.

        Raises:
            DeviceError: The device refuses, or does not answer; the job has ended.
            OSError: The device is gone.
        """
        job, answers = self._job, self._answers
        self._job = ()
        while len(answers) < len(job):
            answer = self._line.answer()
            if answer is None:
                self._job = job
                return True
            self.check(job[len(answers)], answer)
            answers.append(answer)
            if len(answers) < len(job):
                self._line.begin(job[len(answers)])
        if job and not self._writes:
            pairs = list(zip(job, answers, strict=True))
            self._values = self.values_of(pairs)
        return False
