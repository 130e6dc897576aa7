"""Numbers in messages, by paths such as ``twist.linear.x`` or ``position[0:6]``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pbonet.analysis.legality import same_unit
from pbonet.errors import ConfigError, ProtocolError, did_you_mean

from .message_types import dtype_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable

    from .cdr_template import Layout, Template
    from .message_types import Field, MessageTypes

Step = tuple[str, int | None]
"""A field, and which message of a list it is."""
_PART: Final = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)(?:\[(\d+)(?::(\d+))?\])?")
_WHOLE: Final = re.compile(r"([A-Za-z_][A-Za-z0-9_^'.]*)(?:\[(\d+)(?::(\d+))?\])?")
_MOST: Final = 1000
"""Elements that a path may number."""
POSITION: Final = ("rad", "m")
_SPEED, _FORCE = ("rad/s", "m/s"), ("N*m", "N")
UNITS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "sensor_msgs/msg/JointState": {
        "position": POSITION,
        "velocity": _SPEED,
        "effort": _FORCE,
    },
    "sensor_msgs/msg/Imu": {
        "orientation": ("none",),
        "angular_velocity": ("rad/s",),
        "linear_acceleration": ("m/s^2",),
    },
    "sensor_msgs/msg/BatteryState": {
        "voltage": ("V",),
        "temperature": ("degC",),
        "current": ("A",),
        "charge": ("A*hour",),
        "capacity": ("A*hour",),
        "percentage": ("none",),
    },
    "geometry_msgs/msg/Pose": {"position": ("m",), "orientation": ("none",)},
    "geometry_msgs/msg/Transform": {"translation": ("m",), "rotation": ("none",)},
    "geometry_msgs/msg/Twist": {"linear": ("m/s",), "angular": ("rad/s",)},
    "geometry_msgs/msg/Accel": {"linear": ("m/s^2",), "angular": ("rad/s^2",)},
    "geometry_msgs/msg/Wrench": {"force": ("N",), "torque": ("N*m",)},
    "trajectory_msgs/msg/JointTrajectoryPoint": {
        "positions": POSITION,
        "velocities": _SPEED,
        "accelerations": ("rad/s^2", "m/s^2"),
        "effort": _FORCE,
    },
}
"""Units of fields by message, as ROS says them (REP 103 and the messages' comments)."""


class Span(NamedTuple):
    """Some elements of a list."""

    first: int
    end: int


class Leaf(NamedTuple):
    """A number, or an array of numbers, of a message."""

    path: str
    steps: tuple[Step, ...]
    """Fields from the message to it, with the element of lists of messages."""
    field: Field
    units: tuple[str, ...]
    """Units of which one must be that of the variable; empty: any."""
    span: Span | None = None
    """The elements that the path names."""


class Share(NamedTuple):
    """Elements of a variable, as ``Q_MEZ[0:3]`` names them."""

    variable: str
    first: int
    end: int


def share_of(text: str, variables: dict[str, Variable], where: str) -> Share:
    """Return the elements of a variable that a text names.

    Raises:
        ConfigError: There is no such variable, or it has fewer elements.
    """
    match = _WHOLE.fullmatch(text)
    name = match[1] if match else text
    if match is None or name not in variables:
        raise ConfigError(
            f"there is no variable {name}",
            where=where,
            expected="a variable of the table, as NAME, NAME[2] or NAME[0:3]",
            remedy=did_you_mean(name, variables) or "see the .svar file",
        )
    size = variables[name].nelem
    first, end = 0, size
    if match[2] is not None:
        first = int(match[2])
        end = first + 1 if match[3] is None else int(match[3])
    if not 0 <= first < end <= size:
        raise ConfigError(
            f"{text} are no elements of {name}",
            where=where,
            expected=f"elements 0 to {size - 1}; {name}[0:{size}] are all",
            got=text,
        )
    return Share(name, first, end)


def leaves_of(types: MessageTypes, name: str, path: str, where: str) -> list[Leaf]:
    """Return the numbers below a path of a message, in the order of its definition.

    Raises:
        ConfigError: There is no such field, or it has no numbers.
    """
    return _Search(types, path, where).leaves(name)


class _Search:
    """Looks for the numbers below a path.

    Args:
        types: The types of messages.
        path: The path.
        where: The place, for errors.
    """

    def __init__(self, types: MessageTypes, path: str, where: str) -> None:
        self._types, self._path, self._where = types, path, where

    def leaves(self, name: str) -> list[Leaf]:
        """Return the numbers of a message of this type."""
        steps: tuple[Step, ...] = ()
        units: tuple[str, ...] = ()
        parts = self._path.split(".")
        for place, part in enumerate(parts):
            field, span = self._field(name, part)
            units = UNITS.get(name, {}).get(field.name, units)
            if not field.nested:
                if place < len(parts) - 1:
                    raise self._no_field(name, parts[place + 1])
                self._must_be_numbers(field)
                return [
                    Leaf(self._path, (*steps, (field.name, None)), field, units, span)
                ]
            steps = (*steps, (field.name, self._element(field, span)))
            name = field.type
        return self._below(name, steps, units)

    def _field(self, name: str, part: str) -> tuple[Field, Span | None]:
        match = _PART.fullmatch(part)
        fields = {one.name: one for one in self._types.fields(name)}
        if match is None or match[1] not in fields:
            raise self._no_field(name, part)
        if match[2] is None:
            return fields[match[1]], None
        first = int(match[2])
        end = first + 1 if match[3] is None else int(match[3])
        size, bound = fields[match[1]].size, fields[match[1]].bound
        most = 0 if size is None else size or bound or _MOST
        if not first < end <= most:
            raise ConfigError(
                f"{part} are no elements of {match[1]}",
                where=self._where,
                expected=f"elements 0 to {most - 1}, as {match[1]}[0:{min(most, 3)}]"
                if most
                else f"{match[1]}, which is no list",
                got=self._path,
            )
        return fields[match[1]], Span(first, end)

    def _element(self, field: Field, span: Span | None) -> int | None:
        """Return which message of a list of messages is meant."""
        if span is None and field.size is None:
            return None
        if span is not None and span.end == span.first + 1:
            return span.first
        raise ConfigError(
            f"{field.name} is a list of messages",
            where=self._where,
            expected=f"one of them, as {field.name}[0]",
            got=self._path,
        )

    def _below(
        self, name: str, steps: tuple[Step, ...], units: tuple[str, ...]
    ) -> list[Leaf]:
        found: list[Leaf] = []
        for field in self._types.fields(name):
            own = UNITS.get(name, {}).get(field.name, units)
            here = (*steps, (field.name, None))
            if not field.nested:
                self._must_be_numbers(field)
                found.append(Leaf(self._path, here, field, own))
            elif field.size is None:
                found += self._below(field.type, here, own)
            else:
                self._must_be_numbers(field)
        return found

    def _must_be_numbers(self, field: Field) -> None:
        if field.nested or field.type in {"string", "wstring"}:
            raise ConfigError(
                f"{field.name} is not a number",
                where=self._where,
                expected="a number, an array of numbers, or a message of numbers",
                got=self._path,
                remedy="name its numbers, or set it under `constants`",
            )

    def _no_field(self, name: str, part: str) -> ConfigError:
        known = [one.name for one in self._types.fields(name)]
        return ConfigError(
            f"{name} has no field {part}",
            where=self._where,
            expected=" or ".join(known) or "no field at all",
            got=self._path,
            remedy=did_you_mean(part, known),
        )


# -- writing --------------------------------------------------------------------------


class Part(NamedTuple):
    """Elements of a variable that become a leaf of a message."""

    leaf: Leaf
    share: Share

    @property
    def span(self) -> Span:
        """Which elements of the leaf they are."""
        return self.leaf.span or Span(0, self.share.end - self.share.first)


def must_be_whole(parts: Sequence[Part], constants: Iterable[str], where: str) -> None:
    """Refuse numbers of a message that are given twice, and lists with gaps.

    Raises:
        ConfigError: There are such numbers.
    """
    given: dict[str, list[Part]] = {}
    for one in parts:
        given.setdefault(_full_path(one.leaf), []).append(one)
    for path, its in given.items():
        its.sort(key=lambda one: one.span)
        end = 0
        for one in its:
            first = one.span.first
            if first < end or path in constants:
                raise ConfigError(
                    f"{one.leaf.path} is given twice",
                    where=where,
                    expected="each number of a message once",
                    remedy="remove one of them from `fields` and `constants`",
                )
            if first > end and one.leaf.field.size == 0:
                raise ConfigError(
                    f"nothing gives {path}[{end}:{first}]",
                    where=where,
                    expected="all elements of a list, from 0 on",
                    got=one.leaf.path,
                )
            end = one.span.end


def _full_path(leaf: Leaf) -> str:
    """Return the path of a leaf alone, without the elements."""
    return ".".join(
        name if index is None else f"{name}[{index}]" for name, index in leaf.steps
    )


def clear(message: Any, part: Part) -> None:  # noqa: ANN401
    """Let a leaf of a message be zeros, at least as many as a part needs.

    Lists of messages on the way are there already (`grow`).
    """
    field = part.leaf.field
    owner, last = owner_of(message, part.leaf)
    size = 1 if field.size is None else max(len(getattr(owner, last)), part.span.end)
    zeros = np.zeros(size, dtype_of(field.type))
    setattr(owner, last, zeros[0].item() if field.size is None else zeros)


def place(
    template: Template,
    message: Any,  # noqa: ANN401
    part: Part,
) -> tuple[int, np.dtype[Any]]:
    """Return where the numbers of a part stand in its message, and their type."""
    field = part.leaf.field
    owner, last = owner_of(message, part.leaf)
    dtype = np.dtype(dtype_of(field.type))
    size = None if field.size is None else len(getattr(owner, last))
    begin = template.place(owner, last, dtype.name, size)
    return begin + part.span.first * dtype.itemsize, dtype


def owner_of(message: Any, leaf: Leaf) -> tuple[Any, str]:  # noqa: ANN401
    """Return the message that has a leaf as its field, and the field's name."""
    *way, (last, _) = leaf.steps
    return _walk(message, way), last


def cast(values: NDArray[Any], dtype: np.dtype[Any], leaf: Leaf) -> NDArray[Any]:
    """Return numbers in another type, which would wrap what does not fit.

    Raises:
        ProtocolError: One does not fit.
    """
    if dtype.kind == "b" or np.can_cast(values.dtype, dtype) or not values.size:
        return values.astype(dtype)
    numbers = values
    if dtype.kind == "f":  # it has infinities of its own
        least, most = (float(one) for one in (np.finfo(dtype).min, np.finfo(dtype).max))
        numbers = values[np.isfinite(values)]
    else:
        least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
    wrong = [n for n in numbers.tolist() if not least <= n <= most]
    if wrong:
        raise ProtocolError(
            f"a number does not fit {leaf.path}, and the message was not sent",
            expected=f"{leaf.field.type}, {least:g} to {most:g}",
            got=f"{wrong[0]:g}",
            remedy="publish it as a message with a wider type",
        )
    return values.astype(dtype)


def grow(types: MessageTypes, message: Any, leaf: Leaf) -> None:  # noqa: ANN401
    """Let a message have the elements of lists of messages that lead to a leaf."""
    for name, index in leaf.steps[:-1]:
        inner = getattr(message, name)
        if index is not None:
            kind = next(
                one.type for one in types.fields(_type_of(message)) if one.name == name
            )
            while len(inner) <= index:
                inner.append(types.new(kind))
            inner = inner[index]
        message = inner


def _type_of(message: Any) -> str:  # noqa: ANN401 - a message of rosbags
    return str(message.__msgtype__)


def _walk(message: Any, steps: Sequence[Step]) -> Any:  # noqa: ANN401
    for name, index in steps:
        message = getattr(message, name)
        if index is not None:
            message = message[index]
    return message


def width(leaf: Leaf) -> int | None:
    """Return how many numbers a leaf takes; None: as many as there are."""
    if leaf.field.size is None:
        return 1
    if leaf.span is not None:
        return leaf.span.end - leaf.span.first
    return leaf.field.size or None


def must_fit(leaf: Leaf, variable: Variable, where: str) -> None:
    """Refuse a variable of another unit than a leaf has.

    Raises:
        ConfigError: No unit of the leaf is that of the variable.
    """
    if leaf.units and not any(same_unit(variable.units, one) for one in leaf.units):
        raise ConfigError(
            f"{variable.name} does not fit {leaf.path}",
            where=where,
            expected=" or ".join(leaf.units),
            got=variable.units,
            remedy="publish a variable of that unit; the module `gain` converts one",
        )


# -- reading --------------------------------------------------------------------------


class Source(NamedTuple):
    """Where the elements of a link's record come from."""

    leaf: Leaf
    size: int
    by_joint: bool
    """Whether they are in the order of the message's own joint names."""


def source(leaf: Leaf, joints: int, where: str) -> Source:
    """Return how a leaf is read.

    Raises:
        ConfigError: How many elements it has is not said, or it has room for fewer than
            there are joints.
    """
    if leaf.span is not None:
        return Source(leaf, leaf.span.end - leaf.span.first, by_joint=False)
    size = width(leaf)
    if size is None and 0 < leaf.field.bound < joints:
        raise ConfigError(
            f"{leaf.path} has no room for {joints} joints",
            where=where,
            expected=f"at most {leaf.field.bound}, which is its bound",
            remedy="name fewer under `joints`, or change the definition of the type",
        )
    if size is None and not joints:
        raise ConfigError(
            f"{leaf.path} has any number of elements",
            where=where,
            expected=f"which ones, as {leaf.path}[0:6], or `joints`",
        )
    return Source(leaf, size or joints, by_joint=size is None)


def numbers(message: Any, one: Source, order: NDArray[np.intp] | None) -> Any:  # noqa: ANN401
    """Return the numbers of a source in a message.

    Args:
        message: The message.
        one: The source.
        order: The place of each joint in the message.

    Raises:
        ProtocolError: The message has fewer.
    """
    leaf = one.leaf
    try:
        found = _walk(message, leaf.steps)
    except IndexError:
        raise _too_few(leaf, 0, one.size) from None
    if leaf.field.size is None:
        return found
    if one.by_joint and order is not None:
        if len(found) <= int(order.max()):
            raise _too_few(leaf, len(found), len(order))
        return found[order]
    first = leaf.span.first if leaf.span else 0
    if len(found) < first + one.size:
        raise _too_few(leaf, len(found), first + one.size)
    return found[first : first + one.size]


class Slice(NamedTuple):
    """Where the elements of a record stand in a message in CDR."""

    first: int
    """Of the record."""
    end: int
    place: int
    """Of the message, in bytes."""
    size: int
    """Elements there."""
    dtype: np.dtype[Any]
    order: NDArray[np.uint32] | None
    """Which of them; None: all."""


def slices(
    layout: Layout,
    message: Any,  # noqa: ANN401 - by its type
    sources: Sequence[Source],
    order: NDArray[np.intp] | None,
) -> list[Slice]:
    """Return where the numbers of sources stand in messages of a layout.

    Args:
        layout: The layout.
        message: A message that has it and all that the sources need.
        sources: The sources.
        order: The place of each joint in the message.
    """
    found: list[Slice] = []
    first = 0
    for one in sources:
        owner, last = owner_of(message, one.leaf)
        dtype = np.dtype(dtype_of(one.leaf.field.type))
        size = None if one.leaf.field.size is None else len(getattr(owner, last))
        place = layout.place(owner, last, dtype.name, size)
        end = first + one.size
        if one.by_joint and order is not None:
            places = order.astype(np.uint32)
            found.append(Slice(first, end, place, size or 1, dtype, places))
        else:
            place += one.leaf.span.first * dtype.itemsize if one.leaf.span else 0
            found.append(Slice(first, end, place, one.size, dtype, None))
        first = end
    return found


def _too_few(leaf: Leaf, got: int, expected: int) -> ProtocolError:
    return ProtocolError(
        f"{leaf.path} has too few elements",
        expected=f"{expected}",
        got=f"{got}",
        remedy="its sender must give all of them",
    )
