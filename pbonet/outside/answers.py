"""Answers and exceptions as bytes, so that a replay can give them again."""

from __future__ import annotations

import builtins
from typing import Any, Final

import msgspec

from pbonet.errors import DeviceError, PbonetError

ALWAYS: Final = object()
"""The default of a call that needs a record."""
_SCALARS: Final[frozenset[type]] = frozenset({
    *(type(None), bool, int, float, str, bytes)
})
_PLAIN, _PACKED, _TUPLE = 0, 1, 2
_NESTED: Final = 1
"""The extension of msgpack that a tuple within an answer is."""


class NotRecordedError(BaseException):
    """A request that is not recorded; nothing after it can be run again.

    No `Exception`, so that a module that catches those does not continue without it.
    """


def pack(answer: object, where: str) -> tuple[int, bytes]:
    """Return the kind of an answer, and the answer as bytes.

    Raises:
        DeviceError: It cannot be recorded.
    """
    if type(answer) is bytes:
        return _PLAIN, answer
    plain: type = type(answer)
    kind = _TUPLE if plain is tuple else _PACKED
    got = plain.__name__
    whole: Any = answer
    try:
        if not issubclass(plain, int):
            whole = _marked(list(whole) if kind == _TUPLE else whole)
        return kind, msgspec.msgpack.encode(whole)
    except _UnfitError as error:
        if error.kind is not plain:
            got = f"{error.kind.__name__} within a {got}"
    except (TypeError, ValueError, OverflowError):
        pass
    raise DeviceError(
        "this answer cannot be recorded",
        where=where,
        expected="None, a number, text, bytes, or a tuple, list or dictionary of these",
        got=got,
        remedy="ask for plain values and convert them in the module",
    )


class _UnfitError(Exception):
    """Part of an answer has a type that msgpack does not restore exactly."""

    def __init__(self, kind: type) -> None:
        super().__init__()
        self.kind = kind


def _marked(answer: Any) -> Any:  # noqa: ANN401 - whatever was answered
    """Return an answer with its tuples marked, which msgpack takes for lists.

    Raises:
        _UnfitError: Of what cannot be recorded.
    """
    whole: object = answer
    kind: type = type(whole)
    if kind in _SCALARS:
        return answer
    if kind is list:
        return [_marked(one) for one in answer]
    if kind is tuple:
        inner = [_marked(one) for one in answer]
        return msgspec.msgpack.Ext(_NESTED, msgspec.msgpack.encode(inner))
    if kind is dict:
        for key in answer:
            _marked(key)  # a tuple comes back as one: no key is a list
        return {key: _marked(value) for key, value in answer.items()}
    raise _UnfitError(kind)


def _unmarked(_code: int, data: memoryview) -> tuple[Any, ...]:
    return tuple(_DECODER.decode(data))


_DECODER: Final = msgspec.msgpack.Decoder(ext_hook=_unmarked)


def unpack(kind: int, data: bytes) -> Any:  # noqa: ANN401 - whatever was answered
    """Return an answer."""
    if kind == _PLAIN:
        return data
    found = _DECODER.decode(data)
    return tuple(found) if kind == _TUPLE else found


def pack_error(error: Exception) -> bytes:
    """Return an exception as bytes."""
    if isinstance(error, PbonetError):
        return msgspec.msgpack.encode({"pbonet": error.to_wire()})
    first = error.args[0] if len(error.args) == 1 else None
    number, text = None, first if isinstance(first, str) else str(error)
    if isinstance(error, OSError) and error.errno is not None:
        number, text = error.errno, error.strerror or text
    name = type(error).__name__
    return msgspec.msgpack.encode({"name": name, "text": text, "errno": number})


def unpack_error(data: bytes) -> BaseException:
    """Return an exception as it was raised, or the nearest built-in one."""
    found: dict[str, Any] = msgspec.msgpack.decode(data)
    if "pbonet" in found:
        return PbonetError.from_wire(found["pbonet"])
    if found["errno"] is not None:
        return OSError(found["errno"], found["text"])
    kind = getattr(builtins, found["name"], None)
    if isinstance(kind, type) and issubclass(kind, Exception):
        try:
            return kind(found["text"])
        except TypeError:
            pass
    return NotRecordedError(
        f"it raised {found['name']}: {found['text']}, which cannot be made again"
    )
