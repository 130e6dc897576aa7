"""A node of CANopen by its object dictionary: class RCB, driver ``canopen``.

The address is the channel of the CAN bus, such as ``can0``. Port k is the k-th of the
setting `objects`, read and written by one SDO request each. Opening asks for the
node's type (object 1000h). See `RequestDevice` for how a call waits.

Its process data are the driver ``canopen_pdo``.

Its tests have a node that a test makes up. It was not run with hardware here.
"""

from __future__ import annotations

import time
from time import monotonic
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final, NamedTuple

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io.drivers import (
    BusSettings,
    CanBus,
    Kind,
    Line,
    Mode,
    RequestDevice,
    Settings,
    port_claims,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import Entry
    from pbonet.io.drivers import Device, Opening
    from pbonet.outside import Outside

_OBJECT: Final = r"^[0-9a-fA-F]{4}:[0-9a-fA-F]{2}/(8|16|32)$"
_REQUESTS, _ANSWERS = 0x600, 0x580
"""Identities of frames to and from node 0."""
_FRAME: Final = 8
_AT_ONCE: Final = 64
"""Frames that are taken at once."""
_PLAIN: Final = {"is_extended_id": False}
_READ, _READ_BITS, _WRITE, _WRITTEN, _ABORTED = 0x40, 0xE2, 0x23, 0x60, 0x80
"""Commands of an SDO; a value in the answer itself has 42h of its bits E2h."""
_WITH_VALUE: Final = 0x42
_TYPE: Final = 0x1000
"""The object that each node has."""
_AGAIN: Final = 0.001
"""Seconds after which a full interface is tried again."""
NMT: Final = {
    "operational": 0x01,
    "stopped": 0x02,
    "preoperational": 0x80,
    "reset": 0x81,
    "reset communication": 0x82,
}
"""Commands for a node's state."""
ABORTS: Final = {
    0x05040000: "the node waited too long",
    0x06010000: "the object cannot be accessed so",
    0x06010001: "the object can only be written",
    0x06010002: "the object can only be read",
    0x06020000: "it has no such object",
    0x06070010: "the object has another size",
    0x06070012: "the object is shorter",
    0x06070013: "the object is longer",
    0x06090011: "the object has no such subindex",
    0x06090030: "the value is beyond the object's range",
    0x06090031: "the value is too high",
    0x06090032: "the value is too low",
    0x08000020: "the value cannot be stored",
    0x08000021: "the value cannot be stored because of local control",
    0x08000022: "the value cannot be stored in this state of the node",
}
"""A node's reasons to refuse, by code; some of CiA 301."""


class CanopenSettings(
    BusSettings, frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """``[device.NAME.settings]`` of a node, as far as both drivers have them."""

    objects: A[tuple[A[str, Meta(pattern=_OBJECT)], ...], Meta(min_length=1)]
    """``INDEX:SUB/BITS`` of each port, index and subindex in hexadecimal digits."""
    unit: A[int, Meta(ge=1, le=127)] = port_claims.APART["unit"]
    """The node's number."""
    timeout: A[float, Meta(gt=0.0)] = 0.5
    """Seconds in which a request is answered."""


class Sdo(NamedTuple):
    """A request for one object."""

    at: int
    """Its index."""
    sub: int
    """Its subindex."""
    size: int
    """Bytes of the object."""
    value: int | None = None
    """None: the object is read."""

    @property
    def place(self) -> bytes:
        """Index and subindex, as a frame has them."""
        return self.at.to_bytes(2, "little") + bytes((self.sub,))


class CanopenLine(Line[Sdo]):
    """The way to one node.

    Args:
        device: The device of the node.
        where: For errors.
        more: Identities of frames that are received beside its answers.
    """

    def __init__(self, device: Device, where: str, more: Sequence[int]) -> None:
        super().__init__(device.settings.timeout, where)
        self._node = device.settings.unit
        self._answers = _ANSWERS + self._node
        filters = [
            {"can_id": one, "can_mask": 0x7FF, "extended": False}
            for one in (self._answers, *more)
        ]
        reads = Mode.READ in device.opening.mode
        self.bus = CanBus(device, filters, reads=reads)

    def begin(self, request: Sdo) -> None:
        """Hand a request over; what has come before is no answer to it."""
        self.taken()
        self._in.clear()
        super().begin(request)

    def fileno(self) -> int:
        """Return no descriptor: not every interface has one."""
        return -1

    def close(self) -> None:
        """Close the channel."""
        self.bus.close()

    def give(self, data: bytes) -> int:
        """Hand a frame over; return how many of its bytes were taken: all, or none."""
        return len(data) if self.bus.send(_REQUESTS + self._node, data, **_PLAIN) else 0

    def taken(self) -> bytes:
        """Return the frames that have come."""
        found = bytearray()
        for _ in range(_AT_ONCE):
            one = self.bus.receive(0)
            if one is None:
                break
            found += self._answer_in(one)
        return bytes(found)

    def _answer_in(self, one: Any) -> bytes:  # noqa: ANN401 - a message of python-can
        """Return a frame's data, if it is an answer."""
        if one.arbitration_id != self._answers:
            return b""
        return bytes(one.data).ljust(_FRAME, b"\0")

    def wait(self) -> None:
        """Wait for a frame, at most until the answer is late."""
        if self._out:
            time.sleep(_AGAIN)
            return
        one = self.bus.receive(max(0.0, self.ends - monotonic()))
        if one is not None:
            self._in.extend(self._answer_in(one))

    def command(self, number: int) -> bool:
        """Send a command for the node's state; return False if there is no room."""
        return self.bus.send(0, bytes((number, self._node)), **_PLAIN)

    def framed(self, request: Sdo) -> bytes:
        """Return a request as a frame."""
        if request.value is None:
            return bytes((_READ,)) + request.place + bytes(4)
        head = _WRITE | (4 - request.size) << 2
        return bytes((head,)) + request.place + request.value.to_bytes(4, "little")

    def unframed(self, request: Sdo) -> bytes | None:
        """Return the frame that answers; others are dropped."""
        while len(self._in) >= _FRAME:
            one = bytes(self._in[:_FRAME])
            del self._in[:_FRAME]
            if one[1:4] == request.place:
                return one
        return None


class CanopenDevice(RequestDevice[Sdo]):
    """Objects of one node."""

    kind: ClassVar[Kind] = "RCB"
    settings_type: ClassVar[type[Settings]] = CanopenSettings
    packages: ClassVar[tuple[str, ...]] = ("can",)
    _identities: Sequence[int] = ()
    """Of frames that are read beside answers."""

    def __init__(self, entry: Entry, opening: Opening, outside: Outside) -> None:
        super().__init__(entry, opening, outside)
        k = self.settings
        self._objects = [_object(text) for text in k.objects[entry.first :]]
        self.check_ports(len(self._objects))
        self._opened = self._objects[opening.start : opening.end + 1]
        self._where = f"{self.name} ({entry.address}, node {k.unit})"

    def connect(self) -> None:
        """Open the bus, and ask the node; see `Device.connect`."""
        super().connect()
        try:
            if self.opening.mode is not Mode.NONE:
                self.request_now([Sdo(_TYPE, 0, 4)])
        except BaseException:
            self.disconnect()
            raise

    def make_line(self) -> CanopenLine:
        """Return the way to the node."""
        self._node = CanopenLine(self, self._where, self._identities)
        return self._node

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known; there is a port for each object."""
        if command == "PORTNUM":
            return self.entry.ports or len(self._objects)
        return super().status(command, port)

    def control(self, command: str, value: Any) -> None:  # noqa: ANN401
        """Change the node's state: ``NMT``, with one of `NMT`."""
        if command != "NMT":
            super().control(command, value)
        self.require(Mode.WRITE)
        if value not in NMT:
            raise DeviceError(
                "a node has no such state",
                where=self._where,
                expected=", ".join(NMT),
                got=str(value),
                remedy="name one of them",
            )
        if not self.ask(self._command, NMT[value], default=True):
            raise self.no_room()

    def no_room(self) -> DeviceError:
        """Return the error for a bus that takes no frame."""
        return DeviceError(
            "there is no room on the bus",
            where=self._where,
            remedy="try again later; check that the bus has another node",
        )

    def _command(self, number: int) -> bool:
        return self._node.command(number)

    def port_bits(self, port: int) -> int:
        """Return how many bits an object has."""
        return 8 * self._objects[port].size

    def requests_to_read(self) -> Sequence[Sdo]:
        """Return a request for each object."""
        return self._opened

    def requests_to_write(self, values: Sequence[int]) -> Sequence[Sdo]:
        """Return a request for each object."""
        pairs = zip(self._opened, values, strict=True)
        return [one._replace(value=value) for one, value in pairs]

    def check(self, request: Sdo, answer: bytes) -> None:
        """Return if the node did what it was asked for.

        Raises:
            DeviceError: It refuses, or the object has another size.
        """
        command, where = answer[0], f"{self._where}, object {_name(request)}"
        if command == _ABORTED:
            code = int.from_bytes(answer[4:], "little")
            raise DeviceError(
                "the node refuses the request",
                where=where,
                got=f"{ABORTS.get(code, 'for a reason of its own')} (code {code:08X}h)",
                remedy="check objects in agent.toml with the node's dictionary",
            )
        if request.value is not None:
            is_so = command == _WRITTEN
        else:  # the size may be missing
            is_so = command & _READ_BITS == _WITH_VALUE and (
                not command & 1 or 4 - (command >> 2 & 3) == request.size
            )
        if not is_so:
            raise DeviceError(
                "the node's answer does not fit the request",
                where=where,
                expected=f"an object of {request.size} bytes",
                got=answer.hex(" "),
                remedy="check the object's bits in agent.toml",
            )

    def values_of(self, answers: Sequence[tuple[Sdo, bytes]]) -> list[int]:
        """Return the objects' values."""
        return [
            int.from_bytes(answer[4 : 4 + request.size], "little")
            for request, answer in answers
        ]


def _object(text: str) -> Sdo:
    """Return the object that ``INDEX:SUBINDEX/BITS`` names."""
    place, _, bits = text.partition("/")
    index, _, sub = place.partition(":")
    return Sdo(int(index, 16), int(sub, 16), int(bits) // 8)


def _name(request: Sdo) -> str:
    return f"{request.at:04X}:{request.sub:02X}"
