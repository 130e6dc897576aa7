"""Packets in which the machines of a subsystem exchange their tables.

A *group* is what one task of a machine writes together, or one variable that an
operator set. A packet carries news of groups, and, when ownership has changed or a
machine asks, all groups of the machine. Packets are encoded as arrays because there are
many.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
from msgspec import Struct

from pbonet.versions import LAYERS

if TYPE_CHECKING:
    from collections.abc import Sequence

NUMBERS = (1 << 56) - 1
"""Mask for numbers of commits, which wrap around."""
VERSIONS = LAYERS["table"]
"""Versions of packets that are understood; others are refused and reported."""


class Group(Struct, array_like=True):
    """One group, and the epoch of the claim of each of its variables."""

    uid: int
    task: str
    """The writer; empty: an operator."""
    live: bool
    """Whether a task owns it now."""
    vars: list[int]
    epochs: list[int]
    """One for each variable; see `pbonet.svar.mirror.epochs`."""
    ended: bool = False
    """That task has ended, and a successor is to take the variables."""


class News(Struct, array_like=True):
    """The newest commit of a group."""

    uid: int
    seq: int
    age_ns: int
    """Nanoseconds since the commit when the packet was sent."""
    cycle: int
    data: bytes
    """Its variables in the order of their indices, each in whole words."""


class Full(Struct, array_like=True):
    """The whole state of a machine."""

    groups: list[Group]
    ended: list[tuple[int, int]]
    """Variable and epoch of the newest claim that is known to have ended."""
    fights: list[int]
    """Variables owned both by a task here and by one elsewhere."""
    causes: list[tuple[str, str]]
    """Causes and raisers of the illegal-configuration flag."""


class Packet(Struct, array_like=True):
    """A packet from one machine."""

    v: int
    machine: str
    host: str
    run: int
    """A number that differs after each start of the sender."""
    state: int
    """Number of the newest `Full` to which the news belong."""
    sent_ns: int
    """CLOCK_MONOTONIC of the sender's machine."""
    news: list[News]
    full: Full | None = None
    calls: list[bytes] = []
    """Packed `Call`s to make after the rest has been processed."""


class Head(Struct, array_like=True):
    """The begin of a packet, the same in all versions."""

    v: int
    machine: str
    host: str


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Packet)
_head_decoder = msgspec.msgpack.Decoder(Head)
_UNREADABLE = msgspec.MsgspecError, UnicodeDecodeError, RecursionError


def pack(packet: Packet) -> bytes:
    """Return the packet as bytes."""
    return _encoder.encode(packet)


def unpack(data: bytes) -> Packet | None:
    """Return the packet; None if it is malformed or of another version."""
    try:
        packet = _decoder.decode(data)
    except _UNREADABLE:
        return None
    return packet if packet.v in VERSIONS else None


def other_version(data: bytes) -> Head | None:
    """Return the begin of a packet of another version; None if it is none."""
    try:
        head = _head_decoder.decode(data)
    except _UNREADABLE:
        return None
    return head if head.v not in VERSIONS else None


def is_newer(one: News, other: News) -> bool:
    """Return whether a commit is newer than another of its group."""
    return one.seq != other.seq and one.seq - other.seq & NUMBERS < NUMBERS >> 1


def leave_newest(received: Sequence[Packet]) -> None:
    """Remove news of which a later packet contains newer ones."""
    newest: dict[tuple[str, int, int], News] = {}
    for packet in reversed(received):
        left: list[News] = []
        for news in packet.news:
            group = packet.machine, packet.run, news.uid
            if not is_newer(newest.get(group, news), news):
                newest[group] = news
                left.append(news)
        packet.news = left
