"""A special purpose processor of a machine: ``[spp.NAME]`` of an ``agent.toml``."""

from __future__ import annotations

from typing import Final

from msgspec import Struct

SPP_DRIVERS: Final = ("auto", "numpy", "torch", "warp")
"""Back ends; "auto" takes the first one of warp, torch and numpy that a library has."""


class SppEntry(Struct, frozen=True, kw_only=True):
    """A special purpose processor: ``[spp.NAME]`` of an ``agent.toml``."""

    driver: str = "auto"
    """One of `SPP_DRIVERS`."""
    device: str = "auto"
    """``cpu``, ``cuda:0`` and so on; "auto" takes ``cuda:0`` if there is one."""
    memory: float = 0.0
    """Megabytes that libraries may use; 0: no limit."""
    longest: float = 10.0
    """Seconds after which a batch counts as endless, and the executive is ended."""
