"""The format of rmw_zenoh: keys, liveliness tokens, attachments, quality of service.

A topic's messages have the key ``DOMAIN/TOPIC/TYPE/TYPE_HASH``. Each node, publisher,
subscriber, service and client of a service declares a liveliness token, from which all
nodes know of it. An attachment numbers each message.
"""

from __future__ import annotations

import hashlib
import re
import struct
from enum import StrEnum
from typing import Final, NamedTuple

from msgspec import Struct

from pbonet.errors import ProtocolError

ADMIN: Final = "@ros2_lv"
"""The first part of all tokens."""
LONGEST: Final = 1 << 20
"""Bytes of the longest message or request that is decoded, as of a link's record."""
MOST_DOMAIN: Final = 232
"""The largest domain id of ROS 2."""
_LONGEST_TOKEN: Final = 2048
"""Bytes of the longest token that is read; names of ROS have at most 255 each."""
NAME: Final = re.compile(r"/?[A-Za-z_~][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""A topic, service or node; without the first slash it belongs to the node."""
_NUMBER: Final = re.compile(r"[0-9]{1,20}")
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_GID: Final = 16
_TRANSIENT_LOCAL, _VOLATILE = 1, 2
_NODE_PARTS, _END_PARTS = 9, 13


class Kind(StrEnum):
    """The kinds of entity of the ROS graph, as tokens name them."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIBER = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class Qos(Struct, frozen=True):
    """Quality of service, as far as zenoh has a counterpart."""

    reliable: bool = True
    depth: int = 10
    transient_local: bool = False
    """Whether who comes later gets the last messages."""

    @property
    def text(self) -> str:
        """Return it as tokens have it, defaults included, which differ by version."""
        durability = _TRANSIENT_LOCAL if self.transient_local else _VOLATILE
        return f"{2 - self.reliable}:{durability}:1,{self.depth}:,:,:,,"


def must_be_short(size: int) -> None:
    """Refuse a message or request that is too long to be decoded.

    Raises:
        ProtocolError: It has more bytes than `LONGEST`.
    """
    if size > LONGEST:
        raise ProtocolError(
            "a message is too long, and was not read",
            expected=f"at most {LONGEST} bytes",
            got=f"{size} bytes",
            remedy="let its node send less",
        )


def packed(number: int, stamp_ns: int, gid: bytes) -> bytes:
    """Return an attachment as it is sent; see `Attachment`."""
    return _ATTACHMENT.pack(number, stamp_ns, _GID, gid)


class Attachment(NamedTuple):
    """Number, time and sender, which go with each message, request and answer."""

    number: int
    stamp_ns: int
    """When its content was made, nanoseconds since 1970."""
    gid: bytes
    """Identity of its sender, 16 bytes."""

    def pack(self) -> bytes:
        """Return it as it is sent."""
        return packed(*self)

    @classmethod
    def unpack(cls, data: bytes) -> Attachment:
        """Return what was sent.

        Raises:
            ProtocolError: It is no attachment of rmw_zenoh.
        """
        if len(data) != _ATTACHMENT.size or data[16] != _GID:
            raise ProtocolError(
                "this is no attachment of rmw_zenoh",
                expected=f"{_ATTACHMENT.size} bytes: number, time, length 16, identity",
                got=f"{len(data)} bytes",
                remedy="use rmw_zenoh of ROS 2 Jazzy or newer",
            )
        number, stamp_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(number, stamp_ns, gid)


class Node(NamedTuple):
    """A node of the ROS graph."""

    domain: int
    session: str
    """Identity of its zenoh session."""
    name: str
    namespace: str = "/"
    number: int = 0

    @property
    def token(self) -> str:
        """Return the key of its token."""
        return self.token_of(Kind.NODE, self.number)

    def token_of(self, kind: Kind, number: int) -> str:
        """Return the key of a token, as far as it is about the node."""
        head = f"{ADMIN}/{self.domain}/{self.session}/{self.number}/{number}/{kind}"
        return f"{head}/%/{mangled(self.namespace)}/{mangled(self.name)}"

    @property
    def full_name(self) -> str:
        """Return its name with its namespace."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


class End(NamedTuple):
    """A publisher, subscriber, service or client of a node."""

    node: Node
    number: int
    kind: Kind
    name: str
    """Topic or service, with its first slash."""
    type: str
    """As in ``sensor_msgs/msg/JointState``."""
    hash: str
    qos: str = Qos().text

    @property
    def key(self) -> str:
        """Return the key of its messages or requests."""
        name = self.name.strip("/")
        return f"{self.node.domain}/{name}/{dds_type(self.type)}/{self.hash}"

    @property
    def token(self) -> str:
        """Return the key of its token."""
        head = self.node.token_of(self.kind, self.number)
        return (
            f"{head}/{mangled(self.name)}/{dds_type(self.type)}/{self.hash}/{self.qos}"
        )

    @property
    def gid(self) -> bytes:
        """Return its identity."""
        return hashlib.blake2b(self.token.encode(), digest_size=_GID).digest()


def mangled(name: str) -> str:
    """Return a name as one part of a key."""
    return name.replace("/", "%")


def dds_type(name: str) -> str:
    """Return ``sensor_msgs::msg::dds_::JointState_`` for its ROS name."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(dds: str) -> str:
    """Return ``sensor_msgs/msg/JointState`` for its name in keys."""
    return dds.replace("::dds_::", "/").replace("::", "/").removesuffix("_")


def tokens_of(domain: int) -> str:
    """Return the key expression that matches all tokens of a domain."""
    return f"{ADMIN}/{domain}/**"


def parse_token(key: str) -> Node | End | None:
    """Return what a token says; None if it is none that we understand, or too long."""
    if len(key) > _LONGEST_TOKEN or not key.isascii():
        return None
    parts = key.split("/")
    if len(parts) not in {_NODE_PARTS, _END_PARTS} or parts[0] != ADMIN:
        return None
    _, domain, session, nid, number, kind, _, namespace, name, *end = parts
    numbers = (domain, nid, number)
    if not all(map(_NUMBER.fullmatch, numbers)) or kind not in set(Kind):
        return None
    node = Node(int(domain), session, name, namespace.replace("%", "/"), int(nid))
    if not end:
        return node if kind == Kind.NODE else None
    topic, dds, type_hash, qos = end
    return End(
        node,
        int(number),
        Kind(kind),
        topic.replace("%", "/"),
        ros_type(dds),
        type_hash,
        qos,
    )
