"""Defaults from environment variables."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec import Struct
from msgspec.structs import asdict

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path


class Place(Struct, frozen=True, kw_only=True):
    """Where a subsystem is found."""

    domain: str = "default"
    connect: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()
    take_over: bool = False
    confirm: Callable[[str], bool] | None = None
    """Asked before tasks that are CRITICAL and ON are taken over; None: refused."""

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments by which `Subsystem` finds it."""
        return asdict(self)


class Told(NamedTuple):
    """Where agents and modules are found."""

    domain: str
    connect: Sequence[str]
    libraries: Sequence[str | Path]


def or_environment(
    domain: str | None,
    connect: Sequence[str] | None,
    libraries: Sequence[str | Path] | None,
) -> Told:
    """Return the given values, else those of the environment, as for all commands.

    Args:
        domain: None for PBONET_DOMAIN, else ``default``.
        connect: None for PBONET_CONNECT: endpoints, with spaces between.
        libraries: None for PBONET_LIBRARY: folders, with ``:`` between.
    """
    if connect is None:
        connect = os.environ.get("PBONET_CONNECT", "").split()
    if libraries is None:
        named = os.environ.get("PBONET_LIBRARY", "").split(os.pathsep)
        libraries = [folder for folder in named if folder]
    if domain is None:
        domain = os.environ.get("PBONET_DOMAIN") or "default"
    return Told(domain, connect, libraries)


def of(
    domain: str, connect: Sequence[str], libraries: Sequence[str | Path]
) -> dict[str, str]:
    """Return this process's environment with these changes."""
    return {
        **os.environ,
        "PBONET_DOMAIN": domain,
        "PBONET_CONNECT": " ".join(connect),
        "PBONET_ROUTER": "",
        "PBONET_LIBRARY": os.pathsep.join(map(str, libraries)),
    }
