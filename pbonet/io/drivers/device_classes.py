"""The classes of I/O devices: streams, pieces such as frames, ports, and memory.

What a driver of each class reads and writes (Stewart 1994, section 7.2.1). How any
device is opened, made safe and closed is in `device`.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar, Generic, NamedTuple, TypeVar

from pbonet.errors import DeviceError

from .device import Device, Kind
from .modes import Mode, Wait

if TYPE_CHECKING:
    from collections.abc import Sequence

P = TypeVar("P")


class StreamDevice(Device):
    """A device that moves bytes, without ports of a fixed size: class SIO."""

    kind: ClassVar[Kind] = "SIO"
    waits = frozenset(Wait)
    default_wait = Wait.ONE
    one_port = True
    usual_ports = 1
    safe_type = bytes

    @abstractmethod
    def read(self, count: int) -> bytes:
        """Return up to `count` bytes that have arrived; how it waits is the opening's.

        Raises:
            DeviceError: The device is gone, or not open for reading.
        """

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Hand bytes over; return how many were taken.

        Raises:
            DeviceError: The device is gone, or not open for writing.
        """


class Frame(NamedTuple):
    """A frame of a bus, such as CAN."""

    id: int
    """Its identity on the bus."""
    data: bytes = b""
    extended: bool = False
    """Whether the identity has 29 bits instead of 11."""
    fd: bool = False
    """Whether it is a frame of CAN FD, with up to 64 bytes."""
    remote: bool = False
    """Whether it has no data, and asks for a frame of this identity."""
    stamp_ns: int = 0
    """Nanoseconds since 1970 at its arrival, by the kernel where it stamps."""


class FrameDevice(Device, Generic[P]):
    """A device that moves whole pieces: frames of a bus, edges of lines, or samples.

    Its class is SIO. Each port of a bus is an end of its own: it has all frames of the
    bus that its filters pass.
    """

    kind: ClassVar[Kind] = "SIO"
    waits = frozenset(Wait)
    default_wait = Wait.ONE
    one_port = True
    safe_type = list[Frame]

    @abstractmethod
    def read(self, count: int) -> list[P]:
        """Return up to `count` pieces, the oldest first; it waits as it was opened.

        Raises:
            DeviceError: The device is gone, or not open for reading.
        """

    def write(self, frames: Sequence[P]) -> int:
        """Hand pieces over, each one whole; return how many were taken.

        Raises:
            DeviceError: The device is gone, or not open for writing; the bus has no
                such frames.
        """
        self.require(Mode.WRITE)
        del frames
        raise NotImplementedError  # refused at open: a driver that writes has its own

    def check_piece(self, one: P) -> None:
        """Refuse a piece that this bus cannot have; here: none.

        Raises:
            DeviceError: It cannot.
        """
        del one

    def check_safe(self) -> None:
        """Refuse safe pieces that this bus cannot have."""
        for one in self.safe:
            self.check_piece(one)


class PortDevice(Device):
    """A device with ports, each an integer of some bits: PIO, ADC, DAC and RCB.

    A driver implements `read_ports` and `write_ports`, with values of its own width.
    """

    waits = frozenset({Wait.ALL})
    default_wait = Wait.ALL
    safe_type = list[int]

    def read(self) -> list[int]:
        """Return the value of each opened port, as elements of the chosen size.

        They are unsigned numbers of that size; with SIGNED they are signed. Nothing is
        returned (an empty list) if the device did not wait, and has nothing new.

        Raises:
            DeviceError: The device is gone, or not open for reading.
        """
        self.require(Mode.READ)
        raw: Sequence[int] = self.ask(self.read_ports, default=None) or ()
        begin = self.opening.start
        return [
            self.expand(value, self.port_bits(begin + k)) for k, value in enumerate(raw)
        ]

    def write(self, values: Sequence[int]) -> None:
        """Write a value to each opened port, given as elements of the chosen size.

        Raises:
            DeviceError: The device is gone, or not open for writing; there is another
                number of values.
        """
        self.require(Mode.WRITE)
        self._must_fit(values)
        self.ask(self.write_ports, self.raw_of(values), default=None)

    def raw_of(self, values: Sequence[int]) -> list[int]:
        """Return elements of the chosen size as values of the opened ports."""
        begin = self.opening.start
        return [
            self.reduce(int(value), self.port_bits(begin + k))
            for k, value in enumerate(values)
        ]

    def check_safe(self) -> None:
        """Refuse another number of safe values than ports, and those of more bits."""
        self._must_fit(self.safe)
        o = self.opening
        for port, value in enumerate(self.safe, o.start):
            bits = o.size if o.trunc_lsb else min(o.size, self.port_bits(port))
            least = -(1 << bits - 1) if o.signed and bits > 1 else 0
            if not least <= value < least + (1 << bits):
                raise DeviceError(
                    "a safe value is beyond what its port can have",
                    where=f"{self.name}, port {port}",
                    expected=f"{least} to {least + (1 << bits) - 1}",
                    got=str(value),
                    remedy="see safe, size and signed of its opening",
                )

    def _must_fit(self, values: Sequence[int]) -> None:
        o = self.opening
        if len(values) != o.end - o.start + 1:
            raise DeviceError(
                "a value for each opened port is needed",
                where=self.name,
                expected=str(o.end - o.start + 1),
                got=str(len(values)),
                remedy="open only the ports that are written together",
            )

    def read_ports(self) -> Sequence[int] | None:
        """Return the raw values of the opened ports; None: nothing new."""
        raise NotImplementedError  # refused at open: a driver that reads has its own

    def write_ports(self, values: Sequence[int]) -> None:
        """Write raw values to the opened ports."""
        raise NotImplementedError  # refused at open: a driver that writes has its own

    def expand(self, value: int, bits: int) -> int:
        """Return a port's value as an element of the chosen size."""
        o = self.opening
        return convert(value, bits, o.size, signed=o.signed, trunc_lsb=o.trunc_lsb)

    def reduce(self, value: int, bits: int) -> int:
        """Return an element of the chosen size as a port's value, without a sign."""
        o = self.opening
        raw = convert(value, o.size, bits, signed=o.signed, trunc_lsb=o.trunc_lsb)
        return raw & ((1 << bits) - 1)


class MemoryDevice(Device):
    """A block of memory that is mapped: class MEM."""

    kind: ClassVar[Kind] = "MEM"
    waits = frozenset({Wait.ALL})
    default_wait = Wait.ALL
    one_port = True
    usual_ports = 1
    safe_type = dict[int, bytes]

    def _write_safe(self) -> None:
        for at, data in self.safe.items():
            self.write(data, at)

    @abstractmethod
    def read(self, count: int, at: int = 0) -> bytes:
        """Return `count` bytes from offset `at`.

        Raises:
            DeviceError: The device is gone, not open for reading, or shorter.
        """

    @abstractmethod
    def write(self, data: bytes, at: int = 0) -> int:
        """Write bytes from offset `at` on; return how many.

        Raises:
            DeviceError: The device is gone, not open for writing, or shorter.
        """

    @abstractmethod
    def mmap(self) -> memoryview:
        """Return the memory itself; no log has what is read there.

        Raises:
            DeviceError: This is a replay, or the device is gone.
        """


def convert(value: int, bits: int, size: int, *, signed: bool, trunc_lsb: bool) -> int:
    """Return a value of `bits` bits as one of `size` bits.

    By default an expanded value is padded with zeros, and a reduced one loses its
    highest bits (Stewart 1994, section 7.2.1).

    Args:
        value: The value; what exceeds `bits` is cut off.
        bits: How many bits it has.
        size: How many bits the result has.
        signed: Pad with the sign, and return a signed number; one bit has none.
        trunc_lsb: A reduced value loses its lowest bits.
    """
    value &= (1 << bits) - 1
    if signed and size > bits > 1 and value >> (bits - 1):
        value |= (1 << size) - (1 << bits)
    if size < bits:
        value = value >> (bits - size) if trunc_lsb else value & ((1 << size) - 1)
    if signed and value >> (size - 1):
        value -= 1 << size
    return value
