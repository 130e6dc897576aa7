"""Packets in which the machines of a subsystem exchange their tables.

A *group* is what one task of a machine writes together, or one variable that an
operator set. A packet carries news of groups, and, when ownership has changed or
somebody asks, all groups that stand on the machine. Arrays on the wire, as they are
many.
"""

from __future__ import annotations

import msgspec
from msgspec import Struct

VERSION = 1
"""Of packets; machines of another one are not understood, and said to be so."""


class Group(Struct, array_like=True):
    """One group, and since which epoch each of its variables stands there."""

    uid: int
    task: str
    """Empty: an operator set it."""
    live: bool
    """A task owns it now."""
    vars: list[int]
    epochs: list[int]
    """One for each variable; see `pbonet.svar.mirror.epochs`."""


class News(Struct, array_like=True):
    """The newest commit of a group."""

    uid: int
    seq: int
    age_ns: int
    """Since the commit, when the packet was sent."""
    cycle: int
    data: bytes
    """Its variables in the order of their indices, each in whole words."""


class Full(Struct, array_like=True):
    """All that stands on a machine."""

    groups: list[Group]
    ended: list[tuple[int, int]]
    """Variable and epoch of the newest claim that is known to have ended."""
    fights: list[int]
    """Variables that a task here and one elsewhere both own."""
    causes: list[tuple[str, str]]
    """Cause and raiser of the illegal-configuration flag."""


class Packet(Struct, array_like=True):
    """A packet from one machine."""

    v: int
    machine: str
    host: str
    run: int
    """Another one after each start of the sender."""
    state: int
    """Number of the newest `Full` that the news belong to."""
    sent_ns: int
    """CLOCK_MONOTONIC of the sender's machine."""
    news: list[News]
    full: Full | None = None
    calls: list[bytes] = []
    """Whom to call when the rest has been taken in; who carries tables knows how."""


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Packet)


def pack(packet: Packet) -> bytes:
    """Return the packet as bytes."""
    return _encoder.encode(packet)


def unpack(data: bytes) -> Packet | None:
    """Return the packet; None when it is none, or of another version."""
    try:
        packet = _decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None
    return packet if packet.v == VERSION else None
