"""Servos that talk Dynamixel 2.0 on one serial line: class RCB, driver ``dynamixel``.

The address is the line's device file. With n servos, physical port k is register k // n
of the setting `registers`, of servo k % n: so the same register of all servos has
consecutive ports. What is opened together is read by one request for each register, and
written by one. Opening asks each servo whether it is there; of a written value no servo
gives an answer. See `RequestDevice` for how a call waits.

Its tests have servos that a test makes up. It was not run with hardware here.
"""

from __future__ import annotations

from typing import (
    TYPE_CHECKING,
    Annotated as A,
    Any,
    ClassVar,
    Final,
    Literal,
    NamedTuple,
)

from msgspec import Meta

from pbonet.errors import DeviceError

from .device import Kind, Settings
from .modes import Mode
from .request_device import RequestDevice
from .shared_serial_line import SharedLine

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pbonet.config import Entry
    from pbonet.outside import Outside

    from .modes import Opening

PING, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x08, 0x55, 0x82, 0x83
"""Instructions; the last two are for several servos at once."""
ALL: Final = 0xFE
"""The number that means all servos of a line."""
ALERT: Final = 0x80
"""The bit of a status that says that the servo's hardware has an error."""
ERRORS: Final = {
    0: "it gave another number of bytes",
    1: "it could not do it",
    2: "it has no such instruction",
    3: "the packet was damaged on the way to it",
    4: "the value is beyond the register's range",
    5: "it has no such register, or takes another number of bytes",
    6: "the value is beyond a limit that is set in it",
    7: "the register cannot be read or written now, such as with torque on",
}
"""A servo's reasons to refuse an instruction, by number."""
_HEAD: Final = b"\xff\xff\xfd\x00"
_BODY_AT: Final = 7
"""Where a packet's instruction begins; before it are head, number and length."""
_MARK, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
"""The first bytes of a packet: among its values they have one byte more."""
_SHORTEST: Final = 4
"""Length of a status without values: instruction, error, checksum."""


class DynamixelSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of servos; the registers are those of the X series."""

    servos: A[tuple[A[int, Meta(ge=0, le=252)], ...], Meta(min_length=1)]
    """The numbers of the servos."""
    registers: A[
        tuple[tuple[A[int, Meta(ge=0, le=0xFFFF)], Literal[1, 2, 4]], ...],
        Meta(min_length=1),
    ] = ((64, 1), (116, 4), (132, 4))
    """Address and bytes of each: torque on, goal position, present position."""
    baud: int = 57600
    timeout: A[float, Meta(gt=0.0)] = 0.1
    """Seconds in which a request is answered."""


class Packets(NamedTuple):
    """A request, and the servos that answer it."""

    number: int
    """Of the servo that is meant, or `ALL`."""
    instruction: int
    values: bytes
    servos: tuple[int, ...]
    """The servos that answer, in this order."""
    size: int = 0
    """How many bytes each of them gives."""


class DynamixelLine(SharedLine[Packets]):
    """The line to some servos."""

    def begin(self, request: Packets) -> None:
        """Hand a request over as soon as it has its turn."""
        self._found: list[tuple[int, bytes]] = []
        super().begin(request)

    def framed(self, request: Packets) -> bytes:
        """Return a request as a packet."""
        return packet(request.number, request.instruction, request.values)

    def unframed(self, request: Packets) -> bytes | None:
        """Return the statuses of all servos, one after the other.

        Each is the servo's number, how many bytes follow, its error, and its values.
        """
        if not request.servos:
            return b"" if self._sent and not self._out else None
        found = self._found
        while len(found) < len(request.servos) and self._take(request):
            pass
        if len(found) < len(request.servos):
            return None
        return b"".join(bytes((servo, len(body))) + body for servo, body in found)

    def come(self) -> str:
        """Return which servo has not answered, for errors."""
        servo = self._request.servos[len(self._found)]
        return f"no status of servo {servo}, but {super().come()}"

    def _take(self, request: Packets) -> bool:
        """Take a status of the next servo, or drop what is none.

        Returns:
            False: more bytes have to come before.
        """
        data = self._in
        del data[: _head(data)]
        if len(data) < _BODY_AT:
            return False
        length = int.from_bytes(data[_BODY_AT - 2 : _BODY_AT], "little")
        end = _BODY_AT + length
        if _SHORTEST <= length <= _SHORTEST + request.size + request.size // 3:
            if len(data) < end:
                return False
            servo = data[4]
            if (
                servo == request.servos[len(self._found)]
                and data[_BODY_AT] == STATUS
                and int.from_bytes(data[end - 2 : end], "little")
                == crc(data[: end - 2])
            ):
                body = bytes(data[_BODY_AT + 1 : end - 2]).replace(_STUFFED, _MARK)
                self._found.append((servo, body))
                del data[:end]
                return True
        del data[: len(_HEAD)]
        return True


class DynamixelDevice(RequestDevice[Packets]):
    """Registers of several servos."""

    kind: ClassVar[Kind] = "RCB"
    settings_type: ClassVar[type[Settings]] = DynamixelSettings
    packages: ClassVar[tuple[str, ...]] = ("serial",)

    def __init__(self, entry: Entry, opening: Opening, outside: Outside) -> None:
        super().__init__(entry, opening, outside)
        k = self.settings
        self._count = len(k.servos) * len(k.registers) - entry.first
        self.check_ports(self._count)
        self._where = f"{self.name} ({entry.address})"
        ports = range(opening.start + entry.first, opening.end + entry.first + 1)
        self._ports = [self._place(port) for port in ports]

    def _place(self, port: int) -> tuple[tuple[int, int], int]:
        """Return the register and the servo of a physical port."""
        register, servo = divmod(port, len(self.settings.servos))
        return self.settings.registers[register], self.settings.servos[servo]

    def connect(self) -> None:
        """Open the line, and ask each servo; see `Device.connect`."""
        if self.safe is not None:
            self.check_safe()
        super().connect()
        try:
            if self.opening.mode is not Mode.NONE:
                self._ask_each()
        except BaseException:
            self.disconnect()
            raise

    def _ask_each(self) -> None:
        """Ask each servo; if one is silent, the others get their safe values.

        Raises:
            DeviceError: One does not answer, or reports an error.
        """
        servos = dict.fromkeys(servo for _, servo in self._ports)
        try:
            self.request_now([Packets(k, PING, b"", (k,), 3) for k in servos])
        except DeviceError:
            if self.safe is not None:
                self.request_now(self.requests_to_write(self.raw_of(self.safe)))
            raise

    def make_line(self) -> DynamixelLine:
        """Return the serial line."""
        k = self.settings
        line: dict[str, Any] = {"baud": k.baud}
        return DynamixelLine(self.entry.address, line, k.timeout, self._where)

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known; there is a port for each register of each servo."""
        if command == "PORTNUM":
            return self.entry.ports or self._count
        return super().status(command, port)

    def control(self, command: str, value: Any) -> None:  # noqa: ANN401
        """Restart the servo of a port: ``REBOOT``, with the port; it waits."""
        if command != "REBOOT":
            super().control(command, value)
        self.require(Mode.WRITE)
        servo = self._place(self.entry.first + int(value))[1]
        request = Packets(servo, REBOOT, b"", (servo,))
        self.ask(self._request_one, request, default=None)

    def _request_one(self, request: Packets) -> None:
        self.request_now([request])

    def port_bits(self, port: int) -> int:
        """Return how many bits a port's register has."""
        return 8 * self._place(self.entry.first + port)[0][1]

    def requests_to_read(self) -> Sequence[Packets]:
        """Return a request for each register."""
        requests: list[Packets] = []
        for (at, size), servos in self._by_register().items():
            head = at.to_bytes(2, "little") + size.to_bytes(2, "little")
            values = head + bytes(servos)
            requests.append(Packets(ALL, SYNC_READ, values, tuple(servos), size))
        return requests

    def requests_to_write(self, values: Sequence[int]) -> Sequence[Packets]:
        """Return a request for each register."""
        rest = iter(values)
        requests: list[Packets] = []
        for (at, size), servos in self._by_register().items():
            data = at.to_bytes(2, "little") + size.to_bytes(2, "little")
            for servo in servos:
                data += bytes((servo,)) + next(rest).to_bytes(size, "little")
            requests.append(Packets(ALL, SYNC_WRITE, data, ()))
        return requests

    def _by_register(self) -> dict[tuple[int, int], list[int]]:
        found: dict[tuple[int, int], list[int]] = {}
        for register, servo in self._ports:
            found.setdefault(register, []).append(servo)
        return found

    def check(self, request: Packets, answer: bytes) -> None:
        """Return if all servos did what they were asked for.

        Raises:
            DeviceError: One refuses, or reports that its hardware has an error.
        """
        for servo, error, values in _parts(answer):
            if error & ALERT:
                raise DeviceError(
                    "a servo reports an error of its hardware",
                    where=f"{self._where}, servo {servo}",
                    expected="no overload, heat, wrong voltage or electrical shock",
                    got=f"status {error:02X}h",
                    remedy="remove the cause, then control('REBOOT', port)",
                )
            if error or len(values) != request.size:
                raise DeviceError(
                    "a servo refuses the request",
                    where=f"{self._where}, servo {servo}",
                    got=f"{ERRORS.get(error, 'an unknown reason')} (error {error})",
                    remedy="check registers in agent.toml with the servo's table",
                )

    def values_of(self, answers: Sequence[tuple[Packets, bytes]]) -> list[int]:
        """Return the values that the servos gave."""
        return [
            int.from_bytes(values, "little")
            for _, answer in answers
            for _, _, values in _parts(answer)
        ]


def _parts(answer: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield number, error and values of each servo of an answer."""
    at = 0
    while at < len(answer):
        begin = at + 2
        at = begin + answer[at + 1]
        yield answer[begin - 2], answer[begin], answer[begin + 1 : at]


def _head(data: bytearray) -> int:
    """Return where a packet begins, or where the first bytes of one may be."""
    at = data.find(_HEAD)
    return at if at >= 0 else max(0, len(data) - len(_HEAD) + 1)


def packet(number: int, instruction: int, values: bytes) -> bytes:
    """Return a packet with its checksum."""
    body = bytes((instruction,)) + values.replace(_MARK, _STUFFED)
    head = _HEAD + bytes((number,)) + (len(body) + 2).to_bytes(2, "little")
    return head + body + crc(head + body).to_bytes(2, "little")


def crc(data: bytes | bytearray) -> int:
    """Return the checksum of a packet: CRC-16 with 8005h, the highest bit first."""
    value = 0
    for byte in data:
        value = (value << 8 ^ _CRC[value >> 8 ^ byte]) & 0xFFFF
    return value


def _crc_of(value: int) -> int:
    value <<= 8
    for _ in range(8):
        value = value << 1 ^ (0x8005 if value & 0x8000 else 0)
    return value & 0xFFFF


_CRC: Final = tuple(map(_crc_of, range(256)))
