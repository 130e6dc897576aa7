"""The devices of a machine, their users and their last errors, for `pbonet devices`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import DRIVERS
from pbonet.xm.net import messages as m

from .device_opening import driver
from .port_claims import MOST_PORTS, fault, users

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pbonet.config import Entry


def listed(entries: Mapping[str, Entry]) -> list[m.DeviceInfo]:
    """Return devices with the users of their ports and their last errors, by name."""
    return [_listed(name, entry) for name, entry in sorted(entries.items())]


def _listed(name: str, entry: Entry) -> m.DeviceInfo:
    ports = range(entry.ports or MOST_PORTS - entry.first)
    last = fault(entry)
    return m.DeviceInfo(
        name=name,
        driver=entry.driver,
        # An agent runs no code of other packages.
        kind=driver(entry, name).kind if entry.driver in DRIVERS else "",
        address=entry.address,
        first=entry.first,
        ports=entry.ports,
        users=[
            m.PortUser(
                port=one.port, task=one.owner, mode=one.mode.name or "", pid=one.pid
            )
            for one in users(entry, ports)
        ],
        fault=last and m.DeviceFault(text=last.text, task=last.owner, age=last.age),
    )
