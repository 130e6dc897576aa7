"""A device that talks Modbus: class RCB, driver ``modbus``.

The address is HOST:PORT (Modbus TCP), or the device file of a serial line (RTU). Port k
is the k-th register of one table from the entry's `first` on, or the k-th coil. What
is read or written together is one request, or as few as the protocol allows.

With `Wait.ALL` a call waits for the device, at most for the setting `timeout` for each
request: this is for synchronous tasks. With `Wait.NONE` no call waits, for periodic
tasks: a `read` returns what answered the request of a call before it, or nothing, and
makes the next request; a `write` makes a request, or keeps the newest values until the
device has answered the one before. What is wrong with an answer is raised by a later
call. `close` waits until the device has taken what was written last, or `timeout` is
over.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Annotated as A, ClassVar, Literal

from msgspec import Meta

from . import inet_sockets
from .device import Kind, PortDevice, Settings, no_direction
from .modbus_frames import TABLES, Request, TableName, check, reads, values_of, writes
from .modbus_tcp import TcpLine
from .modes import Mode, Wait
from .port_claims import APART

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import Entry
    from pbonet.outside import Outside

    from .modbus_line import Line
    from .modes import Opening


class ModbusSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a device that talks Modbus."""

    unit: A[int, Meta(ge=0, le=255)] = APART["unit"]
    """The device's number on its line."""
    table: TableName = APART["table"]
    timeout: A[float, Meta(gt=0.0)] = 0.5
    """Seconds in which a connection is made, and a request answered."""
    baud: int = 19200
    parity: Literal["N", "E", "O"] = "E"
    stop: Literal[1, 2] = 1


class ModbusDevice(PortDevice):
    """Registers or coils of one table."""

    kind: ClassVar[Kind] = "RCB"
    waits = frozenset({Wait.ALL, Wait.NONE})
    settings_type: ClassVar[type[Settings]] = ModbusSettings

    def __init__(self, entry: Entry, opening: Opening, outside: Outside) -> None:
        super().__init__(entry, opening, outside)
        self._table = TABLES[self.settings.table]
        self._first = entry.first + opening.start
        self._where = f"{self.name} ({entry.address}, unit {self.settings.unit})"

    def connect(self) -> None:
        """Connect with the device; see `Device.connect`."""
        o = self.opening
        if Mode.WRITE in o.mode and not self._table.write:
            raise no_direction(self.name, o.mode, Mode.READ)
        self._line = self._made()
        self._reads = list(reads(self._table, self._first, o.end - o.start + 1))
        self._job: Sequence[Request] = ()
        """The requests that are under way; the last one that began has no answer."""
        self._answers: list[bytes] = []
        self._writes = False
        """Whether that job, or the last one, writes."""
        self._wanted = False
        """Whether values are read, without waiting."""
        self._values: list[int] | None = None
        self._next: Sequence[int] | None = None
        """Values that are written next."""

    def _made(self) -> Line:
        k, address = self.settings, self.entry.address
        if "/" in address:
            from .modbus_rtu import RtuLine  # only where a serial line is used

            line = {"baud": k.baud, "parity": k.parity, "stop": k.stop}
            return RtuLine(address, line, k.unit, k.timeout, self._where)
        made = inet_sockets.connect(address, k.timeout, self._where)
        return TcpLine(made, k.unit, k.timeout, self._where)

    def disconnect(self) -> None:
        """Close the connection, when the device has what was written last."""
        self._wanted = False
        with suppress(OSError):
            while self._next is not None or (self._job and self._writes):
                self._go_on()
                if self._job:
                    self._line.wait()
        self._line.close()

    def port_bits(self, port: int) -> int:
        """Return how many bits a port has: 16, of coils 1."""
        del port
        return self._table.bits

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
            self._begin(list(writes(self._table, self._first, values)), writes=True)
            self._finish()

    def _begin(self, job: Sequence[Request], *, writes: bool) -> None:
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
            self._begin(list(writes(self._table, self._first, values)), writes=True)
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
            check(job[len(answers)], answer, self._where)
            answers.append(answer)
            if len(answers) < len(job):
                self._line.begin(job[len(answers)])
        if job and not self._writes:
            pairs = list(zip(job, answers, strict=True))
            self._values = values_of(self._table, pairs)
        return False
