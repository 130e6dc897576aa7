"""Ports of a device that is asked by requests over a line, and answers them.

With `Wait.ALL` a call waits for the device, at most for the setting `timeout` for each
request: this is for synchronous tasks. With `Wait.NONE` no call waits, for periodic
tasks: a `read` returns what answered the request of a call before it, or nothing, and
makes the next request; a `write` makes a request, or keeps the newest values until the
device has answered the one before. What is wrong with an answer is raised by a later
call. `close` waits until the device has taken what was written last, or `timeout` is
over.
"""

from __future__ import annotations

from abc import abstractmethod
from contextlib import suppress
from typing import TYPE_CHECKING, Generic

from .device import PortDevice
from .modes import Wait
from .request_line import R

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .request_line import Line


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
            self._begin(self.requests_to_write(values), writes=True)
            self._finish()

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
