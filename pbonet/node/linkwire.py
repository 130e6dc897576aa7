"""A record of a link on its way from one machine to another.

One message carries one record: who counts, the counter, the time and age at sending,
what a record looks like, and its bytes as they stand in the writer's memory. The head
is little-endian whatever the machines are; the description names the byte order of the
rest.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from pbonet.errors import ProtocolError

MAGIC = b"pbTB"
VERSION = 1
_HEAD = struct.Struct("<4sHHQQqq")


class Packet(NamedTuple):
    """A record with all that travels with it."""

    number: int
    source: int
    """Whose counter `number` is."""
    stamp_ns: int
    """When it was written, by the writer's machine."""
    age_ns: int
    """Its age when it was sent."""
    text: bytes
    """What a record looks like."""
    data: bytes


def pack(packet: Packet) -> bytes:
    """Return the message that carries a record."""
    number, source, stamp_ns, age_ns, text, data = packet
    head = _HEAD.pack(MAGIC, VERSION, len(text), number, source, stamp_ns, age_ns)
    return b"".join((head, text, data))


def unpack(message: bytes) -> Packet:
    """Return what a message carries.

    Raises:
        ProtocolError: It is malformed, or of another version.
    """
    if len(message) < _HEAD.size or not message.startswith(MAGIC):
        raise ProtocolError(
            "this is no record of a link",
            got=f"{len(message)} bytes",
            remedy="run the same pbonet version on every machine",
        )
    _, version, length, number, source, stamp_ns, age_ns = _HEAD.unpack_from(message)
    if version != VERSION:
        raise ProtocolError(
            "the record is of another version",
            expected=f"version {VERSION}",
            got=f"version {version}",
            remedy="run the same pbonet version on every machine",
        )
    end = _HEAD.size + length
    return Packet(
        number, source, stamp_ns, age_ns, message[_HEAD.size : end], message[end:]
    )
