"""The interface of all I/O devices.

A driver is a class of objects with the methods of Stewart 1994, section 7.2.1: `read`,
`write`, `status`, `control`, `mmap` and `close`, as its class allows. Its values are
raw: units are the matter of the modules above it (section 7.3).
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from contextlib import suppress
from importlib import import_module
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Final,
    Literal,
    Self,
    get_args,
)

import msgspec
from msgspec import Struct

from pbonet.errors import DeviceError
from pbonet.outside import open_devices

from . import database, guard, port_claims
from .modes import Mode, Wait

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.config import Entry
    from pbonet.outside import Outside

    from .modes import Opening
    from .port_claims import Claim

Kind = Literal["SIO", "PIO", "ADC", "DAC", "RCB", "SBS", "MEM"]
"""The classes of devices: serial, parallel, converters from and to analogue values,
robot control boards (a process image of several values), subsystems, and memory."""
SIZES: Final = (8, 16, 32)
"""Bits of an element in the user's buffer."""
PATIENCE: Final = 2.0
"""Seconds for which safe values wait for room in a device that takes no more."""


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """A driver's own settings, of ``[device.NAME.settings]``; a driver derives its."""


class Device(ABC):
    """An opened I/O device. `open_device` makes one.

    A driver derives from one of `StreamDevice`, `FrameDevice`, `PortDevice` and
    `MemoryDevice`.

    Args:
        entry: What the database says.
        opening: What the user chose; it fits the class attributes below.
        outside: Records what the device answers.
    """

    kind: ClassVar[Kind]
    can: ClassVar[Mode] = Mode.RW
    """The directions that the device has."""
    waits: ClassVar[frozenset[Wait]]
    """How it can wait."""
    default_wait: ClassVar[Wait]
    sizes: ClassVar[tuple[int, ...]] = SIZES
    can_trunc_lsb: ClassVar[bool] = True
    one_port: ClassVar[bool] = False
    """Whether it is opened one port at a time."""
    usual_ports: ClassVar[int] = 0
    """How many ports it has where ``agent.toml`` does not say; 0: the driver tells."""
    settings_type: ClassVar[type[Settings]] = Settings
    safe_type: ClassVar[Any]
    """The type of its safe values."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Packages that `connect` imports."""

    def __init__(self, entry: Entry, opening: Opening, outside: Outside) -> None:
        self.entry, self.opening, self.outside = entry, opening, outside
        self.name = opening.name
        self.settings: Any = settings_of(self.settings_type, entry, opening.name)
        self._is_open = False
        self._claim: Claim | None = None
        self.safe: Any = None
        """The safe values, as `write` takes them; None: it is left as it is."""
        self.patience: float | None = None
        """Seconds for which `write` waits for room; None: until there is some."""
        self._guarded = 0
        self._openings = open_devices.current()

    def open(self, claim: Claim | None) -> None:
        """Open the device; `open_device` calls this once.

        Args:
            claim: The claim on its ports, released with the device; None in a replay.

        Raises:
            DeviceError: It cannot be opened; the ports are given back.
        """
        self._claim = claim
        before = set(sys.modules)
        try:
            self.outside.ask(self.connect, default=None)
        except BaseException as error:
            if isinstance(error, DeviceError):
                self._note_fault(error)
            self._release()
            self._await_turn()
            raise
        self._is_open = True
        is_claimed = claim is not None or self.outside.plays
        if self.safe is not None:
            try:
                self.outside.ask(self.check_safe, default=None)
                if is_claimed:
                    self._watch(guard.Told(self.safe, _loaded_since(before)))
            except BaseException:
                self.shut()
                raise
        if is_claimed:
            self._openings.add(self)

    def prepare(self) -> None:
        """Load what opening needs: it is opened later, in an `on` that must be short.

        Opening names a package that is missing.
        """
        before = set(sys.modules)
        for name in self.packages:
            with suppress(ImportError):
                import_module(name)
        if self.safe is not None:
            guard.prepare(self.entry, self.name, _loaded_since(before))

    @property
    def is_open(self) -> bool:
        """Whether it is open: neither closed, nor lost, nor given up for another."""
        return self._is_open

    def is_wanted(self) -> bool:
        """Return whether another task waits for one of its ports."""
        claim = self._claim
        return self._is_open and self.outside.ask(
            lambda: claim is not None and claim.is_wanted(self.entry, self.opening),
            default=False,
        )

    def _watch(self, told: guard.Told) -> None:
        """Have the claim guarded; a replay has none, and calls nothing."""
        claim = self._claim

        def watch() -> None:
            if claim is not None:
                self._guarded = guard.watch(self.entry, self.opening, told, claim.fd)

        self.outside.ask(watch, default=None)

    def _note_fault(self, error: DeviceError) -> None:
        """Write an error down, for `pbonet devices`."""
        if self._claim is not None:
            self._claim.note(str(error), database.owner())

    def _release(self) -> None:
        number, self._guarded = self._guarded, 0
        if number:
            guard.forget(number)
        if self._claim is not None:
            self._claim.release()

    def take_safe(self, values: object) -> None:
        """Set the safe values.

        Raises:
            DeviceError: They are of a wrong type.
        """
        try:
            plain = msgspec.to_builtins(values, builtin_types=(bytes,))
            self.safe = msgspec.convert(plain, self.safe_type)
        except (msgspec.ValidationError, TypeError) as error:
            raise _no_safe(self.name, self.safe_type, str(error)) from None

    def check_safe(self) -> None:
        """Refuse safe values that the opened device cannot have; here: none.

        Raises:
            DeviceError: It cannot.
        """
        return

    def write_safe(self, *, wait: bool = True) -> None:
        """Write the safe values.

        Args:
            wait: Wait until the device has them, however it was opened.

        Raises:
            DeviceError: The device is gone, or does not answer.
        """
        opening = self.opening
        if not wait:
            self._write_safe()
            return
        self.opening, self.patience = opening._replace(wait=Wait.ALL), PATIENCE
        try:
            self._write_safe()
        finally:
            self.opening, self.patience = opening, None

    def _write_safe(self) -> None:
        self.write(self.safe)

    @abstractmethod
    def write(self, data: Any, /) -> Any:  # noqa: ANN401
        """Write what its class moves.

        Raises:
            DeviceError: The device is gone, or not open for writing.
        """

    @abstractmethod
    def connect(self) -> None:
        """Open the hardware. Not called in a replay; it returns nothing.

        Raises:
            DeviceError: It cannot be opened.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Close the hardware; the safe values were written before."""

    def close(self) -> None:
        """Write the safe values, close the device, and give its ports back.

        Closing twice is allowed.

        Raises:
            DeviceError: The safe values could not be written; it is closed.
        """
        try:
            if self._is_open and self.safe is not None:
                self.write_safe()
        finally:
            self.shut()

    def give_up(self) -> None:
        """Close the device for another task, and wait for it in turn.

        Raises:
            DeviceError: The safe values could not be written. Where the device is not
                lost, it stays open: its task and its guard have it.
        """
        if self._is_open and self.safe is not None:
            self.write_safe()
        self.shut()
        self._await_turn()

    def _await_turn(self) -> None:
        """Wait for the ports, which another task may have before they are opened."""
        with suppress(OSError):  # then it is refused the ports, which says so
            self.outside.ask(port_claims.mark, self.entry, self.opening, default=None)

    def shut(self) -> None:
        """Close the device without its safe values: it is lost, or was not used."""
        if self._is_open:
            self._is_open = False
            self._openings.remove(self)
            try:
                if not self.outside.plays:
                    self.disconnect()
            finally:
                self._release()

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the hardware.

        Args:
            command: ``PORTSIZE`` (bits of a port), ``PORTNUM`` (number of ports of the
                logical device), or one of the driver.
            port: For ``PORTSIZE``.

        Raises:
            DeviceError: The device has no such command, or does not answer.
        """
        if command == "PORTNUM":
            return self.entry.ports or self.usual_ports
        if command == "PORTSIZE":
            return self.port_bits(port)
        raise self._no_command(command)

    def control(self, command: str, value: Any) -> None:  # noqa: ANN401
        """Change a setting of the hardware, as ``SIO_SET``.

        Raises:
            DeviceError: The device has no such command, or refuses the value.
        """
        del value
        raise self._no_command(command)

    def port_bits(self, port: int) -> int:
        """Return how many bits a port has."""
        del port
        return 8

    def check_ports(self, count: int) -> None:
        """Return if the device has the opened ports.

        Args:
            count: How many ports the logical device can have, by the driver.

        Raises:
            DeviceError: It has not.
        """
        o = self.opening
        if o.end >= count:
            raise DeviceError(
                "the device has no such ports",
                where=f"{self.name} ({self.entry.address})",
                expected=f"0 to {count - 1}" if count > 0 else "none",
                got=f"{o.start} to {o.end}",
                remedy=f"see first and settings of [device.{self.name}]",
            )

    def require(self, mode: Mode) -> None:
        """Return if the device was opened in this direction.

        Raises:
            DeviceError: It was not.
        """
        if mode not in self.opening.mode:
            raise not_open_for(self.name, mode, self.opening.mode)

    def ask(self, call: Callable[..., Any], *args: object, default: Any) -> Any:  # noqa: ANN401
        """Return what an open device answers, recorded; in a replay, the record.

        Raises:
            DeviceError: It is closed, or lost: then it is closed by this.
        """
        if not self._is_open:
            raise DeviceError(
                "the device is not open",
                where=self.name,
                remedy="open it in init, and again after it was lost",
            )
        try:
            return self.outside.ask(call, *args, default=default)
        except DeviceError as error:  # it refuses or is silent, and stays open
            self._note_fault(error)
            raise
        except OSError as error:
            gone = DeviceError(
                "the device is gone",
                where=f"{self.name} ({self.entry.address})",
                got=error.strerror or str(error),
                remedy="check cable and power, then open it again",
            )
            self._note_fault(gone)
            self.shut()
            self._await_turn()
            raise gone from None

    def _no_command(self, command: str) -> DeviceError:
        return DeviceError(
            f"a device of class {self.kind} has no command {command}",
            where=self.name,
            expected="PORTSIZE, PORTNUM, or one that docs/devices.md lists",
            remedy="see the page of the driver",
        )

    def __enter__(self) -> Self:
        """Return the device itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the device."""
        self.close()


def _loaded_since(before: set[str]) -> list[str]:
    """Return the modules that were loaded since, in their order."""
    return [name for name in sys.modules if name not in before]


def settings_of(kind: type[Settings], entry: Entry, name: str) -> Settings:
    """Return the driver's settings of a device.

    Raises:
        DeviceError: One is not known, or of another type.
    """
    try:
        return msgspec.convert(entry.settings, kind)
    except msgspec.ValidationError as error:
        raise DeviceError(
            "a setting of the device is wrong",
            where=f"[device.{name}.settings]",
            expected=" ".join(one.name for one in msgspec.structs.fields(kind)),
            got=str(error),
            remedy=f"see the driver {entry.driver} in docs/devices.md",
        ) from None


_NAMES: Final[dict[Any, str]] = {
    bytes: "bytes",
    list[int]: "a number for each port",
    dict[int, bytes]: "bytes by offset, as {0: bytes(4)}",
}
"""Safe values that are no frames of a bus, in words."""


def _no_safe(name: str, kind: Any, got: str) -> DeviceError:  # noqa: ANN401
    return DeviceError(
        "the safe values of the device have a wrong type",
        where=name,
        expected=_NAMES.get(kind) or f"a list of {get_args(kind)[0].__name__}",
        got=got,
        remedy="give them as write() takes them",
    )


def unsaid(name: str) -> DeviceError:
    """Return the error for a device that is written and has no safe values."""
    return DeviceError(
        "it is not said how the device is left when its task is not ON, or gone",
        where=name,
        expected="safe=VALUES, as write() takes them, or safe=None",
        remedy="name the values that are safe; with safe=None it keeps what was "
        "written last",
    )


def never_written(name: str) -> DeviceError:
    """Return the error for safe values of a device that is not written."""
    return DeviceError(
        "a device that is not written has no safe values",
        where=name,
        expected="mode=Mode.WRITE or Mode.RW",
        got="safe=",
        remedy="name the mode, or leave safe= out",
    )


def not_open_for(name: str, wanted: Mode, opened: Mode) -> DeviceError:
    """Return the error for a direction that a device was not opened in."""
    return DeviceError(
        "the device is not open in this direction",
        where=name,
        expected=f"opened with {wanted}",
        got=str(opened),
        remedy="name the mode when it is opened",
    )


def no_direction(name: str, wanted: Mode, can: Mode) -> DeviceError:
    """Return the error for a direction that a device does not have."""
    return DeviceError(
        "the device cannot be opened in this direction",
        where=name,
        expected=f"{can}, or {Mode.NONE}",
        got=str(wanted),
        remedy="open it otherwise, or another device",
    )
