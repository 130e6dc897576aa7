"""A device that talks Modbus: class RCB, driver ``modbus``.

The address is HOST:PORT (Modbus TCP), or the device file of a serial line (RTU). Port k
is the k-th register of one table from the entry's `first` on, or the k-th coil. What
is read or written together is one request, or as few as the protocol allows. See
`RequestDevice` for how a call waits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated as A, ClassVar, Literal

from msgspec import Meta

from . import inet_sockets
from .device import Kind, Settings, no_direction
from .modbus_protocol import (
    TABLES,
    Request,
    RtuLine,
    TableName,
    TcpLine,
    check,
    reads,
    values_of,
    writes,
)
from .modes import Mode
from .port_claims import APART
from .request_device import RequestDevice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import Entry
    from pbonet.outside import Outside

    from .modes import Opening
    from .request_device import Line


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


class ModbusDevice(RequestDevice[Request]):
    """Registers or coils of one table."""

    kind: ClassVar[Kind] = "RCB"
    settings_type: ClassVar[type[Settings]] = ModbusSettings
    packages: ClassVar[tuple[str, ...]] = ("serial",)

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
        super().connect()

    def make_line(self) -> Line[Request]:
        """Return the line to the device."""
        k, address = self.settings, self.entry.address
        if "/" in address:
            line = {"baud": k.baud, "parity": k.parity, "stop": k.stop}
            return RtuLine(address, line, k.unit, k.timeout, self._where)
        made = inet_sockets.connect(address, k.timeout, self._where)
        return TcpLine(made, k.unit, k.timeout, self._where)

    def port_bits(self, port: int) -> int:
        """Return how many bits a port has: 16, of coils 1."""
        del port
        return self._table.bits

    def requests_to_read(self) -> Sequence[Request]:
        """Return the requests that read the opened ports."""
        o = self.opening
        return list(reads(self._table, self._first, o.end - o.start + 1))

    def requests_to_write(self, values: Sequence[int]) -> Sequence[Request]:
        """Return the requests that write the opened ports."""
        return list(writes(self._table, self._first, values))

    def requests_one_by_one(self, values: Sequence[int]) -> Sequence[Request]:
        """Return a request for each port: a block is refused as a whole."""
        return [
            request
            for port, value in enumerate(values, self._first)
            for request in writes(self._table, port, [value])
        ]

    def check(self, request: Request, answer: bytes) -> None:
        """Return if the device did what it was asked for."""
        check(request, answer, self._where)

    def values_of(self, answers: Sequence[tuple[Request, bytes]]) -> list[int]:
        """Return the values that the answers have."""
        return values_of(self._table, answers)
