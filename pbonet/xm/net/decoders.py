"""Decode into types that one thread has prepared.

msgspec (0.22) prepares a `Struct` when it is first decoded into, which runs Python and
so lets other threads run. One that decodes into it meanwhile finds it half prepared,
and the process ends by SIGSEGV. Once prepared, a type is safe for all threads. Here a
lock keeps every other thread out meanwhile.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
from msgspec import Struct

if TYPE_CHECKING:
    from types import ModuleType

T = TypeVar("T")

_preparing = threading.Lock()
_prepared: set[object] = set()


def decoder(
    kind: Any,  # noqa: ANN401 - a type or a union of types
) -> msgspec.msgpack.Decoder[Any]:
    """Return a decoder of messages of a type."""
    with _preparing:
        return msgspec.msgpack.Decoder(kind)


def prepare(module: ModuleType) -> None:
    """Prepare every `Struct` of a module."""
    for one in vars(module).values():
        if isinstance(one, type) and issubclass(one, Struct):
            decoder(one)


def convert(value: object, kind: type[T], *, strict: bool = True) -> T:
    """Return a part of a message as a value of a type.

    Args:
        value: The part.
        kind: The type.
        strict: Whether a text is no number, and the like.

    Raises:
        msgspec.ValidationError: It is none.
    """
    if kind not in _prepared:
        decoder(kind)
        _prepared.add(kind)
    return msgspec.convert(value, kind, strict=strict)
