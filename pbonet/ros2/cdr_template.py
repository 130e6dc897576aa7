"""A message of one layout in CDR, into which numbers are written where they stand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .message_types import MessageTypes

_MARK: Final = b"\x11"
"""A byte that is not 0; in each type, some of them are a number like any other."""


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
        count = 1 if size is None else size
        mark = np.frombuffer(_MARK * (count * kind.itemsize), kind)
        if kind.kind == "b":
            mark = np.ones(count, kind)
        before = getattr(owner, field)
        setattr(owner, field, mark[0].item() if size is None else mark)
        marked = self._types.encode(self._name, self._message)
        setattr(owner, field, before)
        differs = np.frombuffer(marked, np.uint8) != np.frombuffer(
            self._bytes, np.uint8
        )
        return np.ndarray(count, kind, self._bytes, int(differs.argmax()))

    def copy(self) -> bytes:
        """Return the message as it stands."""
        return bytes(self._bytes)
