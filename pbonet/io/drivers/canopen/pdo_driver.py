"""Process data of a CANopen node: class RCB, driver ``canopen_pdo``.

Port k is the k-th of the setting `objects`. An opening that reads maps its objects into
the node's transmit PDOs, which the node then sends once in `period`; one that writes
maps them into receive PDOs, which are sent with each `write`. An opening has one of
the two directions. The node is pre-operational while it is opened, and operational
afterwards.

With `Wait.ALL` a read waits until all of its PDOs have come again, at most for
`timeout`, and a write for room on the bus. With `Wait.NONE` a read returns nothing
while one is missing, and raises when none has come for `timeout`; frames for which
there is no room are dropped, so the next ones are the newest.

Its tests have a node that a test makes up. It was not run with hardware here.
"""

from __future__ import annotations

import time
from time import monotonic
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Settings, Wait

from .sdo_driver import NMT, CanopenDevice, CanopenSettings, Sdo

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_BYTES: Final = 8
"""Of a PDO."""
_MOST: Final = 4
"""PDOs of each direction whose identities CiA 301 assigns."""
_SENT, _RECEIVED = (0x1800, 0x180), (0x1400, 0x200)
"""Parameters of the node's first PDO of each direction, and its identity."""
_MAPPINGS: Final = 0x200
"""From the parameters of a PDO to its mapping."""
_STEP: Final = 0x100
"""From the identity of a PDO to that of the next one."""
_OFF: Final = 1 << 31
"""Of an identity: the PDO does not exist now."""
_BY_EVENT: Final = 255
"""The type of transmission: when the timer ends, or a frame comes."""
_AT_ONCE: Final = 64
"""Frames that are taken at once."""
_AGAIN: Final = 0.001
"""Seconds after which a full interface is tried again."""


class PdoSettings(
    CanopenSettings, frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """``[device.NAME.settings]`` of process data."""

    period: A[float, Meta(ge=0.001, le=65.0)] = 0.01
    """Seconds from one of the node's frames to the next."""
    pdo: A[int, Meta(ge=1, le=_MOST)] = 1
    """The first PDO that is used."""


class PdoDevice(CanopenDevice):
    """Objects of one node as process data."""

    settings_type: ClassVar[type[Settings]] = PdoSettings

    def connect(self) -> None:
        """Map the opened objects, and start the node; see `Device.connect`."""
        o = self.opening
        if o.mode is Mode.RW:
            raise DeviceError(
                "process data are read or written, and not both",
                where=self.name,
                expected="mode READ of the node's inputs, or WRITE of its outputs",
                got=str(o.mode),
                remedy="open the ports of each direction by themselves",
            )
        first, identity = _SENT if o.mode is Mode.READ else _RECEIVED
        number = self.settings.pdo - 1
        self._maps = list(_maps(self._opened))
        self._identities = [
            identity + (number + k) * _STEP + self.settings.unit
            for k in range(len(self._maps))
        ]
        self._must_have_pdos()
        super().connect()
        try:
            self._data: dict[int, bytes] = {}
            """Bytes that came since the last read, by identity."""
            if o.mode is not Mode.NONE:
                self._start(first + number)
            self._heard = monotonic()
        except BaseException:
            self.disconnect()
            raise

    def read_ports(self) -> Sequence[int] | None:
        """Return the opened objects' values; None: not all have come again."""
        if self.opening.wait is Wait.NONE:
            self._take()
        else:
            self._await()
        if len(self._data) < len(self._maps):
            if monotonic() - self._heard > self.settings.timeout:
                raise self._silent()
            return None
        self._heard = monotonic()
        data, self._data = self._data, {}
        return [
            value
            for identity, objects in zip(self._identities, self._maps, strict=True)
            for value in _unpacked(data[identity], objects)
        ]

    def write_ports(self, values: Sequence[int]) -> None:
        """Send the opened objects' values."""
        rest = iter(values)
        for identity, objects in zip(self._identities, self._maps, strict=True):
            data = b"".join(next(rest).to_bytes(one.size, "little") for one in objects)
            self._send(identity, data)

    def _send(self, identity: int, data: bytes) -> None:
        waits = self.opening.wait is not Wait.NONE
        ends = monotonic() + (self.patience or self.settings.timeout)
        while not self._node.bus.send(identity, data, is_extended_id=False):
            if not waits:
                return
            if monotonic() > ends:
                raise self.no_room()
            time.sleep(_AGAIN)

    def _take(self) -> None:
        for _ in range(_AT_ONCE):
            one = self._node.bus.receive(0)
            if one is None:
                return
            self._note(one)

    def _await(self) -> None:
        self._take()
        self._data.clear()  # which came before it was asked for
        ends = monotonic() + self.settings.timeout
        while len(self._data) < len(self._maps):
            one = self._node.bus.receive(max(0.0, ends - monotonic()))
            if one is None:
                raise self._silent()
            self._note(one)

    def _note(self, one: Any) -> None:  # noqa: ANN401 - a message of python-can
        identity, data = int(one.arbitration_id), bytes(one.data)
        if identity not in self._identities:
            return  # it answers a request that is over
        objects = self._maps[self._identities.index(identity)]
        size = sum(obj.size for obj in objects)
        if len(data) != size:
            raise DeviceError(
                "the node's process data do not fit their mapping",
                where=self._where,
                expected=f"{size} bytes with identity {identity:X}h",
                got=data.hex(" ") or "nothing",
                remedy="give each PDO one user; check that no other node has its "
                "identity",
            )
        self._data[identity] = data

    def _must_have_pdos(self) -> None:
        last = self.settings.pdo - 1 + len(self._maps)
        if last > _MOST:
            raise DeviceError(
                "the objects do not fit into the node's process data",
                where=self._where,
                expected=f"at most {_MOST} PDOs of {_BYTES} bytes",
                got=f"objects that need PDO {self.settings.pdo} to {last}",
                remedy="open fewer ports, or lower pdo; read the rest by the driver "
                "canopen",
            )

    def _start(self, parameters: int) -> None:
        """Map the objects into PDOs, and let the node send and take them."""
        self._set_state("preoperational")
        jobs = [
            request
            for k, objects in enumerate(self._maps)
            for request in self._mapping(parameters + k, self._identities[k], objects)
        ]
        self.request_now(jobs)
        self._set_state("operational")

    def _mapping(
        self, parameters: int, identity: int, objects: Sequence[Sdo]
    ) -> Iterator[Sdo]:
        """Yield the requests that set a PDO up, which does not exist meanwhile."""
        mapping = parameters + _MAPPINGS
        yield Sdo(parameters, 1, 4, identity | _OFF)
        yield Sdo(parameters, 2, 1, _BY_EVENT)
        if self.opening.mode is Mode.READ:
            yield Sdo(parameters, 5, 2, round(self.settings.period * 1000))
        yield Sdo(mapping, 0, 1, 0)
        for k, one in enumerate(objects, 1):
            yield Sdo(mapping, k, 4, one.at << 16 | one.sub << 8 | 8 * one.size)
        yield Sdo(mapping, 0, 1, len(objects))
        yield Sdo(parameters, 1, 4, identity)

    def _set_state(self, name: str) -> None:
        if not self._command(NMT[name]):
            raise self.no_room()

    def _silent(self) -> DeviceError:
        self._heard = monotonic()
        missing = [f"{one:X}h" for one in self._identities if one not in self._data]
        return DeviceError(
            "the node sends no process data",
            where=self._where,
            expected=f"identities {' '.join(missing)} within "
            f"{self.settings.timeout:g} s",
            remedy="check that it is switched on and operational; after a restart it "
            "has lost its mapping: open the device again",
        )


def _maps(objects: Sequence[Sdo]) -> Iterator[list[Sdo]]:
    """Yield the objects of each PDO, in their order."""
    some: list[Sdo] = []
    for one in objects:
        if sum(obj.size for obj in some) + one.size > _BYTES:
            yield some
            some = []
        some.append(one)
    yield some


def _unpacked(data: bytes, objects: Sequence[Sdo]) -> Iterator[int]:
    at = 0
    for one in objects:
        yield int.from_bytes(data[at : at + one.size], "little")
        at += one.size
