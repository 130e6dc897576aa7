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
        self.bytes = bytearray(types.encode(name, message))
        """The message as it stands."""

    def place(
        self,
        owner: Any,  # noqa: ANN401 - a message, by its type
        field: str,
        dtype: str,
        size: int | None,
    ) -> int:
        """Return where the numbers of a field begin in the encoded message.

        Args:
            owner: The message that has the field: the whole one, or one in it.
            field: Its name.
            dtype: The type of its numbers.
            size: How many it has; None if it is no array.
        """
        before = getattr(owner, field)
        setattr(owner, field, _marked(np.dtype(dtype), size, _MARK))
        marked = self._types.encode(self._name, self._message)
        setattr(owner, field, before)
        return int((_bytes_of(marked) != _bytes_of(self.bytes)).argmax())


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
        same = marked == _bytes_of(self._template.bytes)
        mask = np.zeros(len(data), np.uint8)
        mask[: len(same)] = same[: len(data)] * np.uint8(0xFF)
        self.mask = mask.tobytes()
        """255 for each byte that is the same in all messages, and 0 for others."""
        self.rest = (mask & _bytes_of(data)).tobytes()
        """Bytes of the message that are the same in all, and 0 for others."""
        self.place = self._template.place
        """Returns where the numbers of a field begin; see `Template.place`."""


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
