"""MAVLink messages unpacked, by pymavlink's tables of their fields.

pymavlink's own `decode` checks the check sum once more and makes a message that can be
sent again, which takes several times as long.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from .mavlink_frames import SIGNED, V2

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from .mavlink_frames import Frame

_V1_HEADER, _V2_HEADER = 6, 10
_SIGNATURE = 13


class Message:
    """A received message: its fields as attributes, as the protocol names them.

    Args:
        name: Its kind.
        frame: What it was received in.
        fields: The fields, by name.
    """

    def __init__(self, name: str, frame: Frame, fields: dict[str, Any]) -> None:
        self.__dict__ = fields
        self._name, self._frame = name, frame

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - the fields, for checkers
        raise AttributeError(f"{self._name} has no field {name}")

    def get_type(self) -> str:
        """Return its kind."""
        return self._name

    def get_srcSystem(self) -> int:  # noqa: N802 - as pymavlink has it
        """Return the system that sent it."""
        return self._frame.system

    def get_srcComponent(self) -> int:  # noqa: N802
        """Return the component that sent it."""
        return self._frame.component


_Span = tuple[str, int, int]
"""A field, its first value, and how many it has."""


class _Kind(NamedTuple):
    """How a kind of message is unpacked."""

    name: str
    unpacker: Any
    size: int
    fields: tuple[str, ...]
    """In the order on the wire."""
    spans: tuple[_Span, ...]
    """Empty if no field is an array or text."""


class Unpacker:
    """Unpacks frames whose check sum is right.

    Args:
        kinds: pymavlink's classes by number.
    """

    def __init__(self, kinds: Mapping[int, Any]) -> None:
        self._classes = kinds
        self._kinds: dict[int, _Kind] = {}

    def unpack(self, frame: Frame) -> Message:
        """Return the message of a frame."""
        kind = self._kinds.get(frame.kind) or self._learn(frame.kind)
        data, size = frame.data, kind.size
        if data[0] == V2:
            end = len(data) - 2 - (_SIGNATURE if data[2] & SIGNED else 0)
            payload = data[_V2_HEADER:end]
        else:
            payload = data[_V1_HEADER:-2]
        if len(payload) != size:  # zeros at the end are not sent
            payload = payload[:size].ljust(size, b"\0")
        values = kind.unpacker.unpack(payload)
        if kind.spans:
            return Message(kind.name, frame, _with_arrays(kind.spans, values))
        fields = dict(zip(kind.fields, values, strict=True))
        return Message(kind.name, frame, fields)

    def _learn(self, number: int) -> _Kind:
        made = self._classes[number]
        names, first, spans = tuple(made.ordered_fieldnames), 0, list[_Span]()
        for name, length in zip(names, made.lengths, strict=True):
            spans.append((name, first, length))
            first += length
        plain = not any(made.array_lengths)
        kind = _Kind(
            made.msgname,
            made.unpacker,
            made.unpacker.size,
            names,
            () if plain else tuple(spans),
        )
        self._kinds[number] = kind
        return kind


def _with_arrays(spans: Sequence[_Span], values: Sequence[Any]) -> dict[str, Any]:
    """Return the fields of a message with arrays or texts."""
    fields = dict[str, Any]()
    for name, first, length in spans:
        one = values[first] if length == 1 else list(values[first : first + length])
        if isinstance(one, bytes):
            one = one.split(b"\0", 1)[0].decode("ascii", "replace")
        fields[name] = one
    return fields
