"""An entry of the device database."""

from __future__ import annotations

from typing import Any

from msgspec import Struct


class Entry(Struct, frozen=True, kw_only=True):
    """A device: ``[device.NAME]`` of an ``agent.toml``."""

    driver: str
    """The driver's name, see docs/devices.md."""
    address: str
    """Where the device is: a device file, HOST:PORT, a folder of sysfs."""
    first: int = 0
    """The physical port that is port 0 of this logical device."""
    ports: int = 0
    """How many ports it has; 0: as many as the driver finds."""
    settings: dict[str, Any] = {}
    """The driver's own settings."""
