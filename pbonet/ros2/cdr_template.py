"""A message of one layout in CDR, into which numbers are written where they stand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .message_types import dtype_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .message_types import MessageTypes

_MARK, _OTHER = b"\x11", b"\x22"
"""Bytes that are not 0; in each type, some of one are a number like any other."""
_PADDING = 4


class Template:
    """A message in CDR whose texts and lengths of lists do not change.

    So each number stands at the same place in every message, and only numbers are
    copied when one is sent. rosbags encodes the message; a number's place is found by
    encoding it once more with another value there.

    Args:
        types: The types of messages.
        name: The message's type.
        message: The message; numbers that are written later are 0.
    """

    def __init__(self, types: MessageTypes, name: str, message: object) -> None:
        self._types, self._name, self._message = types, name, message
        self._bytes = bytearray(types.encode(name, message))

    def numbers(
        self,
        owner: Any,  # noqa: ANN401 - a message, by its type
        field: str,
        dtype: str,
        size: int | None,
    ) -> NDArray[Any]:
        """Return the numbers of a field, as they stand in the encoded message.

        Args:
            owner: The message that has the field: the whole one, or one in it.
            field: Its name.
            dtype: The type of its numbers.
            size: How many it has; None if it is no array.
        """
        kind = np.dtype(dtype)
        before = getattr(owner, field)
        setattr(owner, field, _marked(kind, size, _MARK))
        marked = self._types.encode(self._name, self._message)
        setattr(owner, field, before)
        differs = _bytes_of(marked) != _bytes_of(self._bytes)
        count = 1 if size is None else size
        return np.ndarray(count, kind, self._bytes, int(differs.argmax()))

    def offset_of(self, numbers: NDArray[Any]) -> int:
        """Return where numbers of the message begin in it."""
        return numbers.ctypes.data - _bytes_of(self._bytes).ctypes.data

    def copy(self) -> bytes:
        """Return the message as it stands."""
        return bytes(self._bytes)


class Layout:
    """The places of numbers in the messages that have the layout of one of them.

    All texts and lengths of lists are those of that message, joints' names among them,
    so that only numbers differ.

    Args:
        types: The types of messages.
        name: The messages' type.
        data: One of them in CDR, as it came.
        message: The same, decoded; it is overwritten.
    """

    def __init__(
        self,
        types: MessageTypes,
        name: str,
        data: bytes,
        message: Any,  # noqa: ANN401 - by its type
    ) -> None:
        self._size = len(data)
        own = types.encode(name, message)
        self.is_known = data.startswith(own) and len(data) - len(own) < _PADDING
        """Whether the sender encodes as rosbags does, but for bytes at the end."""
        _fill(types, name, message, _MARK)
        marked = _bytes_of(types.encode(name, message))
        _fill(types, name, message, _OTHER)
        self._template = Template(types, name, message)
        same = marked == _bytes_of(self._template.copy())
        self._mask = int.from_bytes((same * np.uint8(0xFF)).tobytes(), "little")
        self._rest = int.from_bytes(data, "little") & self._mask

    def place(self, owner: Any, field: str, dtype: str, size: int | None) -> int:  # noqa: ANN401
        """Return where the numbers of a field begin; see `Template.numbers`."""
        found = self._template.numbers(owner, field, dtype, size)
        return self._template.offset_of(found)

    def fits(self, data: bytes) -> bool:
        """Return whether a message has this layout."""
        return (
            self.is_known
            and len(data) == self._size
            and int.from_bytes(data, "little") & self._mask == self._rest
        )


def _fill(types: MessageTypes, name: str, message: Any, mark: bytes) -> None:  # noqa: ANN401
    """Let all numbers of a message be made of the same byte."""
    for field in types.fields(name):
        value = getattr(message, field.name)
        if field.nested:
            for one in [value] if field.size is None else value:
                _fill(types, field.type, one, mark)
        elif field.type not in {"string", "wstring"}:
            size = None if field.size is None else len(value)
            number = _marked(np.dtype(dtype_of(field.type)), size, mark)
            setattr(message, field.name, number)


def _marked(kind: np.dtype[Any], size: int | None, mark: bytes) -> Any:  # noqa: ANN401
    """Return a number that is made of one byte, or an array of them."""
    count = 1 if size is None else size
    found = np.full(count * kind.itemsize, mark[0], np.uint8).view(kind)
    if kind.kind == "b":
        found = np.full(count, mark == _MARK)
    return found[0].item() if size is None else found


def _bytes_of(data: bytes | bytearray) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)
