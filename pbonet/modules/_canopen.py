"""Frames of CANopen (CiA 301): commands to a node, its heartbeat, and its objects."""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from pbonet.io.drivers import Frame

START, PRE_OPERATIONAL = 0x01, 0x80
"""Commands of the network management."""
BOOT_UP, OPERATIONAL = 0x00, 0x05
"""States of a node, as its heartbeat says them."""
EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x80, 0x580, 0x600, 0x700
"""The part of a frame's identity that is added to the node's number."""
NO_OBJECT: Final = 0x06020000
"""Why a node refuses an object that it does not have."""
_SDO: Final = struct.Struct("<BHB")
_WRITE, _WRITTEN, _ABORT = 0x23, 0x60, 0x80


class Object(NamedTuple):
    """A value for an object of a node's dictionary."""

    number: int
    sub: int
    value: int
    size: int
    """Bytes: 1, 2 or 4."""
    optional: bool = False
    """Whether a node may do without it."""

    def __str__(self) -> str:
        """Return it as manuals name it, ``6060h:0``."""
        return f"{self.number:04X}h:{self.sub}"


def command(node: int, what: int) -> Frame:
    """Return a command of the network management."""
    return Frame(0, bytes((what, node)))


def heartbeat(node: int) -> Frame:
    """Return the sign of life of an operational node."""
    return Frame(HEARTBEAT + node, bytes((OPERATIONAL,)))


def write(node: int, what: Object) -> Frame:
    """Return the request that writes an object of a node."""
    kind = _WRITE | (4 - what.size) << 2
    value = (what.value & (1 << 8 * what.size) - 1).to_bytes(4, "little")
    return Frame(SDO_REQUEST + node, _SDO.pack(kind, what.number, what.sub) + value)


def refusal(data: bytes, what: Object) -> int | None:
    """Return what a node answers to `write`: 0 for done, or its code; None: no answer.

    An answer that belongs to another object is none.
    """
    if len(data) < 8:  # noqa: PLR2004 - of CiA 301
        return None
    kind, index, sub = _SDO.unpack_from(data)
    if (index, sub) != (what.number, what.sub) or kind not in {_WRITTEN, _ABORT}:
        return None
    return int.from_bytes(data[4:8], "little") if kind == _ABORT else 0
