"""The ways in which a device is opened."""

from __future__ import annotations

from enum import Enum, Flag
from typing import NamedTuple


class Mode(Flag):
    """The direction in which a device is opened."""

    NONE = 0
    """Neither: only `status` and `control`."""
    READ = 1
    WRITE = 2
    RW = 3


class Wait(Enum):
    """How `read` and `write` wait."""

    ALL = "all"
    """For all that was asked for."""
    ONE = "one"
    """For at least one piece."""
    NONE = "none"
    """Never: what is there."""
    NOALL = "noall"
    """Never: all, or nothing."""


class Opening(NamedTuple):
    """The choices of a user at open."""

    name: str
    """The logical name."""
    start: int
    end: int
    """The first and the last port."""
    mode: Mode
    wait: Wait
    size: int
    """Bits of an element in the user's buffer."""
    signed: bool
    """Whether an expanded value keeps its sign."""
    trunc_lsb: bool
    """Whether a reduced value loses its lowest bits instead of its highest ones."""
