"""Opens devices by their logical names, and checks what is asked for at once."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

import msgspec

from pbonet.config import DRIVERS, Entry
from pbonet.errors import DeviceError, DeviceTakenError
from pbonet.io import require_devices
from pbonet.outside import Outside

from . import database, port_claims
from .device import Device, never_written, no_direction, unsaid
from .modes import Mode, Opening, Wait


def driver(entry: Entry, name: str) -> type[Device]:
    """Return the driver of a device: one of `DRIVERS`, or ``package.module:Class``.

    Raises:
        DeviceError: There is none of that name.
    """
    own = DRIVERS.get(entry.driver)
    module, _, cls = (own or entry.driver).partition(":")
    try:
        if not cls:
            raise _no_driver(entry, name, "")
        found = import_module(f".{module}" if own else module, __package__)
        made: object = getattr(found, cls)
    except (ImportError, AttributeError, ValueError) as error:
        raise _no_driver(entry, name, str(error)) from None
    if not (isinstance(made, type) and issubclass(made, Device)):
        raise _no_driver(entry, name, f"{cls} is no Device")
    return made


def _no_driver(entry: Entry, name: str, got: str) -> DeviceError:
    return DeviceError(
        f"there is no driver {entry.driver}",
        where=f"[device.{name}]",
        expected=" ".join([*sorted(DRIVERS), "package.module:Class"]),
        got=got,
        remedy="see docs/devices.md",
    )


UNSAID: Final = object()
"""The value of `safe` where nothing was said."""


def open_device(
    name: str,
    start: int = 0,
    end: int | None = None,
    *,
    mode: Mode = Mode.NONE,
    wait: Wait | None = None,
    size: int = 32,
    signed: bool = False,
    trunc_lsb: bool = False,
    safe: object = UNSAID,
) -> Any:  # noqa: ANN401 - its class is that of the driver
    """Open ports of a device, in ``init`` (iodOpen of Stewart 1994, section 7.2.1).

    The ports are this opening's until it is closed, or its process ends.

    Args:
        name: The logical name: ``[device.NAME]`` of the agent's ``agent.toml``.
        start: The first port.
        end: The last port; by default the first one.
        mode: Whether it is read, written, or both.
        wait: How `read` and `write` wait; by default ALL, and ONE of streams.
        size: Bits of an element: 8, 16 or 32.
        signed: A value that is expanded keeps its sign.
        trunc_lsb: A value that is reduced loses its lowest bits.
        safe: Of a device that is written: what is written to it when it is closed, when
            the task comes to OFF or ERROR or ends, and when its process is gone, as
            `write` takes it; of memory, bytes by offset. None: nothing is.

    Returns:
        A `StreamDevice`, `FrameDevice`, `PortDevice` or `MemoryDevice`, by its driver.

    Raises:
        DeviceTakenError: Another task has a port. This task, if it lives on, waits for
            it: when the other one is no longer ON, it closes the device.
        DeviceError: There is no such device, it cannot what is asked for, a port is
            taken, or the hardware cannot be opened.
    """
    outside = Outside(f"device {name} {start}")
    if not outside.plays:
        require_devices(name)
    found = outside.ask(lambda: msgspec.to_builtins(database.entry(name)))
    entry = msgspec.convert(found, Entry)
    cls = driver(entry, name)
    chosen = Opening(
        name=name,
        start=start,
        end=start if end is None else end,
        mode=mode,
        wait=cls.default_wait if wait is None else wait,
        size=size,
        signed=signed,
        trunc_lsb=trunc_lsb,
    )
    _check(cls, entry, chosen)
    device = cls(entry, chosen, outside)
    _take_safe(device, mode, safe)
    # A refusal is recorded and raised again; a claim is no answer, and is not recorded.
    claims: list[port_claims.Claim] = []
    outside.ask(lambda: claims.append(_claim(device)), default=None)
    device.open(claims[0] if claims else None)
    return device


def _claim(device: Device) -> port_claims.Claim:
    """Claim the ports of a device; where it has to wait for them, prepare the rest."""
    try:
        return port_claims.claim(device.entry, device.opening)
    except DeviceTakenError:
        device.prepare()
        raise


def _take_safe(device: Device, mode: Mode, safe: object) -> None:
    """Give a device its safe values; one that is written must have them, or None.

    Raises:
        DeviceError: It is not said, they are of a wrong type, or it is not written.
    """
    if safe is UNSAID and Mode.WRITE in mode:
        raise unsaid(device.name)
    if safe is UNSAID or safe is None:
        return
    if Mode.WRITE not in mode:
        raise never_written(device.name)
    device.take_safe(safe)


def _check(cls: type[Device], entry: Entry, o: Opening) -> None:
    """Refuse what the driver cannot do.

    Raises:
        DeviceError: It cannot.
    """
    if o.mode & ~cls.can:
        raise no_direction(o.name, o.mode, cls.can)
    wrong = {
        f"wait {o.wait.value}": o.wait not in cls.waits,
        f"size {o.size}": o.size not in cls.sizes,
        "trunc_lsb": o.trunc_lsb and not cls.can_trunc_lsb,
    }
    able = [one.value for one in Wait if one in cls.waits], list(cls.sizes)
    for what, is_so in wrong.items():
        if is_so:
            raise DeviceError(
                f"the driver {entry.driver} cannot do this",
                where=o.name,
                expected=f"wait {' '.join(able[0])}; size {able[1]}",
                got=what,
                remedy="open it in another way",
            )
    ports = entry.ports or cls.usual_ports
    last = ports - 1 if ports else o.end
    if not 0 <= o.start <= o.end <= last or (cls.one_port and o.start != o.end):
        raise DeviceError(
            "the device has no such ports",
            where=o.name,
            expected=f"one of 0 to {last}" if cls.one_port else f"0 to {last}",
            got=f"{o.start} to {o.end}",
            remedy=f"see [device.{o.name}] in agent.toml",
        )
