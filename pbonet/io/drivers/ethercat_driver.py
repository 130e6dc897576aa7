"""A bus of EtherCAT by its process image: class MEM, driver ``ethercat``.

The address is the network interface, such as ``eth1``. `exchange` carries the outputs
to all slaves and brings their inputs. `read` returns bytes of these inputs: those of
the first slave, of the second one, and so on. `write` sets bytes of the outputs, in the
same order, for the next exchange. Opening brings all slaves to the state OPERATIONAL,
with their safe values as outputs, and 0 where there are none. Closing carries the safe
values and brings them back to INIT.

An exchange waits for the bus, at most for the setting `timeout`: some ten microseconds
for a short bus.

Its tests have a bus at pysoem's edge. It was not run with hardware here.
"""

from __future__ import annotations

import errno
from contextlib import suppress
from importlib import import_module
from typing import Annotated as A, Any, ClassVar, Final

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io import from_extra

from .device import Settings
from .device_classes import MemoryDevice
from .modes import Mode

_STATE_TIMEOUT: Final = 50_000
"""Microseconds in which slaves change their state, at each attempt."""
_ATTEMPTS: Final = 40


class EthercatSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a bus."""

    slaves: A[int, Meta(ge=1)]
    """How many slaves the bus has: another number is refused."""
    timeout: A[float, Meta(gt=0.0, le=0.1)] = 0.002
    """Seconds in which an exchange has ended."""
    lost: A[int, Meta(ge=1)] = 3
    """Exchanges without an answer of all slaves, one after the other: then the bus
    counts as lost."""


class EthercatDevice(MemoryDevice):
    """The process image of one bus."""

    settings_type: ClassVar[type[Settings]] = EthercatSettings
    packages: ClassVar[tuple[str, ...]] = ("pysoem",)
    can_trunc_lsb = False

    def connect(self) -> None:
        """Find the slaves and bring them into operation; see `Device.connect`."""
        with from_extra("ethercat", f"the device {self.name}"):
            self._soem: Any = import_module("pysoem")
        self._master: Any = self._soem.Master()
        self._missed, self._inputs, self._outputs = 0, b"", bytearray()
        if self.opening.mode is Mode.NONE:
            return
        try:
            self._master.open(self.entry.address)
            self._find()
            self._operate()
        except DeviceError:
            self.disconnect()
            raise
        except Exception as error:  # noqa: BLE001 - pysoem's have no common class
            self.disconnect()
            raise self._unusable(str(error)) from None

    def _find(self) -> None:
        """Find the slaves and lay out the image.

        Raises:
            DeviceError: There is another number of them.
        """
        found = max(0, self._master.config_init())
        if found != self.settings.slaves:
            raise self._unusable(f"{found} slaves")
        self._master.config_map()

    def _operate(self) -> None:
        """Bring all slaves into operation, with their safe values as outputs.

        Raises:
            DeviceError: One does not go.
        """
        master, wanted = self._master, self._soem.OP_STATE
        master.state_check(self._soem.SAFEOP_STATE, _STATE_TIMEOUT * _ATTEMPTS)
        self._outputs = bytearray(sum(len(one.output) for one in master.slaves))
        if self.safe is not None:
            self.check_safe()
            for at, data in self.safe.items():
                self._write(data, at)
        self._lay_out()
        self._exchange_once()
        master.state = wanted
        master.write_state()
        for _ in range(_ATTEMPTS):  # slaves want the image before they go
            self._exchange_once()
            if master.state_check(wanted, _STATE_TIMEOUT) == wanted:
                self._inputs = b"".join(one.input for one in master.slaves)
                return
        master.read_state()
        wrong = [
            f"{k} ({one.name}): {self._soem.al_status_code_to_string(one.al_status)}"
            for k, one in enumerate(master.slaves, 1)
            if one.state != wanted
        ]
        raise self._unusable(f"slave {'; '.join(wrong)}" if wrong else "no answer")

    def disconnect(self) -> None:
        """Bring the slaves back to INIT and close the interface."""
        with suppress(Exception):
            self._master.state = self._soem.INIT_STATE
            self._master.write_state()
        with suppress(Exception):
            self._master.close()

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known: ``IMAGE`` gives the bytes of inputs and outputs."""
        if command == "IMAGE":
            return tuple(self.ask(self._sizes, default=()))
        return super().status(command, port)

    def _sizes(self) -> list[int]:
        return [len(self._inputs), len(self._outputs)]

    def exchange(self) -> None:
        """Carry the outputs to the slaves and bring their inputs.

        Raises:
            DeviceError: Not all slaves answered; or the bus is gone, when that happened
                some times one after the other.
        """
        if self.opening.mode is Mode.NONE:
            self.require(Mode.RW)
        self.ask(self._exchange, default=None)

    def _exchange(self) -> None:
        self._lay_out()
        got, wanted = self._exchange_once(), self._master.expected_wkc
        if got >= wanted:
            self._missed = 0
            self._inputs = b"".join(one.input for one in self._master.slaves)
            return
        self._missed += 1
        if self._missed >= self.settings.lost:
            raise OSError(errno.ENETDOWN, "the slaves do not answer any more")
        raise DeviceError(
            "not all slaves answered",
            where=f"{self.name} ({self.entry.address})",
            expected=f"working counter {wanted}",
            got=str(got),
            remedy="check cables and power of the slaves; the inputs are old",
        )

    def _lay_out(self) -> None:
        """Give each slave its part of the outputs."""
        at = 0
        for one in self._master.slaves:
            one.output = bytes(self._outputs[at : at + len(one.output)])
            at += len(one.output)

    def _exchange_once(self) -> int:
        """Send the image and take it back; return the working counter."""
        self._master.send_processdata()
        limit = round(self.settings.timeout * 1e6)
        counter: int = self._master.receive_processdata(limit)
        return counter

    def read(self, count: int, at: int = 0) -> bytes:
        """Return inputs of the last exchange; see `MemoryDevice.read`."""
        self.require(Mode.READ)
        data: bytes = self.ask(self._read, count, at, default=b"")
        return data

    def _read(self, count: int, at: int) -> bytes:
        self._check(count, at, len(self._inputs))
        return self._inputs[at : at + count]

    def write(self, data: bytes, at: int = 0) -> int:
        """Set outputs for the next exchange; see `MemoryDevice.write`."""
        self.require(Mode.WRITE)
        self.ask(self._write, data, at, default=None)
        return len(data)

    def _write(self, data: bytes, at: int) -> None:
        self._check(len(data), at, len(self._outputs))
        self._outputs[at : at + len(data)] = data

    def check_safe(self) -> None:
        """Refuse safe values beyond the outputs."""
        for at, data in self.safe.items():
            self._check(len(data), at, len(self._outputs))

    def _write_safe(self) -> None:
        """Set the safe values, and carry them to the slaves.

        Raises:
            DeviceError: Not all slaves answered, in as many exchanges as the setting
                `lost` says.
        """
        super()._write_safe()
        for left in reversed(range(self.settings.lost)):
            try:
                self.exchange()
            except DeviceError:
                if not left or not self._is_open:
                    raise
            else:
                return

    def mmap(self) -> memoryview:
        """Refuse to map the image.

        Raises:
            DeviceError: Always; it is carried by `exchange`.
        """
        raise DeviceError(
            "the image of a bus is not mapped",
            where=self.name,
            remedy="use exchange, read and write",
        )

    def _check(self, count: int, at: int, size: int) -> None:
        """Return if the image has these bytes.

        Raises:
            DeviceError: It has not.
        """
        if not 0 <= at <= at + count <= size:
            raise DeviceError(
                "the image of the bus has no such bytes",
                where=f"{self.name} ({self.entry.address})",
                expected=f"0 to {size - 1}",
                got=f"{at} to {at + count - 1}",
                remedy='see status("IMAGE")',
            )

    def _unusable(self, got: str) -> DeviceError:
        return DeviceError(
            "the EtherCAT bus cannot be opened",
            where=f"{self.name} ({self.entry.address})",
            expected=f"an interface with {self.settings.slaves} slaves in operation",
            got=got,
            remedy="check interface, cables and slaves; it needs the right CAP_NET_RAW",
        )
