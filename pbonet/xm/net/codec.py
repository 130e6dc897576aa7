"""Packs and unpacks messages; refuses those it does not understand."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Final

import msgspec
from msgspec import Struct

from pbonet.errors import PbonetError, ProtocolError
from pbonet.versions import LAYERS, REMEDY

from .decoders import decoder
from .messages import VERSION, Answer, Event, Request

if TYPE_CHECKING:
    from collections.abc import Collection

    from .any_message import AnyMessage


FROZEN: Final = frozenset({"hello", "stop"})
"""Requests that every version takes from every other one; their fields do not change,
and the answer has the version of the request."""


class _Version(Struct):
    """The fields that are decoded first."""

    v: int = 0
    id: str = ""
    op: str = ""


_VERSION: msgspec.msgpack.Decoder[_Version] = decoder(_Version)
MALFORMED = (msgspec.MsgspecError, UnicodeDecodeError)
"""Exceptions of decoding: msgspec does not wrap errors of invalid UTF-8."""


class Codec:
    """Packs and unpacks messages; refuses those it does not understand."""

    MAX_BYTES: ClassVar[int] = 1 << 20

    def __init__(self) -> None:
        self._encoder = msgspec.msgpack.Encoder()
        self._answer: msgspec.msgpack.Decoder[Answer] = decoder(Answer)

    @cached_property
    def _request(self) -> msgspec.msgpack.Decoder[AnyMessage]:
        """The decoder of requests, which only servers need."""
        from .any_message import AnyMessage

        return decoder(AnyMessage)

    def pack(self, message: Request | Answer | Event) -> bytes:
        """Return the message as msgpack bytes."""
        return self._encoder.encode(message)

    def request(self, data: bytes) -> AnyMessage:
        """Return the request in `data`.

        Raises:
            ProtocolError: It is too long, malformed, or of another version and not
                one of `FROZEN`.
        """
        self._check(data, FROZEN)
        try:
            return self._request.decode(data)
        except MALFORMED as error:
            raise ProtocolError(
                "the request is not understood",
                got=str(error),
                remedy="see docs/protocol.md for the fields of each operation",
            ) from None

    def answer(self, data: bytes, to: Request | None = None) -> Answer:
        """Return the answer in `data`.

        Args:
            data: The answer.
            to: The request that it answers, which may be one of `FROZEN`.

        Raises:
            ProtocolError: It is too long, malformed, or of another version.
        """
        if to is not None and to.__struct_config__.tag in FROZEN:
            self._head(data)
        else:
            self._check(data)
        try:
            return self._answer.decode(data)
        except MALFORMED as error:
            raise ProtocolError(
                "the answer is not understood",
                got=str(error),
                remedy="run the same pbonet version on every machine",
            ) from None

    def version(self, data: bytes) -> int:
        """Return the version of a message, which need not be understood otherwise.

        Raises:
            ProtocolError: It is too long, or not msgpack.
        """
        return self._head(data).v

    def _check(self, data: bytes, frozen: Collection[str] = ()) -> None:
        head, known = self._head(data), LAYERS["commands"]
        if head.v not in known and head.op not in frozen:
            raise ProtocolError(
                "the message is of another protocol version",
                expected=str(known),
                got=f"version {head.v}",
                remedy=REMEDY,
            )

    def _head(self, data: bytes) -> _Version:
        if len(data) > self.MAX_BYTES:
            raise ProtocolError(
                "the message is too long",
                expected=f"at most {self.MAX_BYTES} bytes",
                got=f"{len(data)} bytes",
                remedy="send it in parts, or send less",
            )
        try:
            return _VERSION.decode(data)
        except MALFORMED as error:
            raise ProtocolError(
                "the message is not msgpack",
                got=str(error),
                remedy="send a msgpack map, as described in docs/protocol.md",
            ) from None


def failure(error: PbonetError, request_id: str = "", v: int = VERSION) -> Answer:
    """Return the answer that carries `error`, to a request of version `v`."""
    return Answer(v=v, id=request_id, ok=False, error=error.to_wire())


def refusal(error: PbonetError, data: bytes) -> Answer:
    """Return the answer to a request that is refused, decoded or not.

    It has the id and version of the request; a version that is not understood is
    answered in this program's own, which tells the client so.
    """
    try:
        head = _VERSION.decode(data)
    except MALFORMED:
        return failure(error)
    known = head.v in LAYERS["commands"] or head.op in FROZEN
    return failure(error, head.id, head.v if known else VERSION)
