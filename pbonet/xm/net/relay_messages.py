"""Messages between a task and its agent about resources of other machines."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import msgspec
from msgspec import Struct

from pbonet.errors import PbonetError, ProtocolError

from .decoders import convert

if TYPE_CHECKING:
    from .messages import Answer

T = TypeVar("T")


class Letter(Struct, array_like=True):
    """A request to be passed on by the agent; answered with a packed `Answer`."""

    client: str
    rtpu: str
    """Empty: asks for the names of the RTPUs that are alive, if it waits."""
    timeout: float
    data: bytes
    """The packed request."""
    wait: bool = True
    """Whether an answer is wanted."""
    report: bool = False
    """Whether to deliver it in order and report a failure, without an answer."""


def read_names(data: bytes) -> list[str]:
    """Return the names of RTPUs."""
    return msgspec.msgpack.decode(data, type=list[str])


def read_result(rtpu: str, answer: Answer, result: type[T]) -> T:
    """Return the result in an answer.

    Raises:
        PbonetError: The agent refused.
        ProtocolError: The result has another type.
    """
    if not answer.ok:
        raise PbonetError.from_wire(answer.error or {})
    try:
        return convert(answer.result, result)
    except msgspec.ValidationError as error:
        raise ProtocolError(
            "the result is not of the operation's type",
            where=rtpu,
            got=str(error),
            remedy="run the same pbonet version on every machine",
        ) from None
