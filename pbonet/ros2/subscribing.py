"""Topics as links, which tasks read as those of any other subsystem."""

from __future__ import annotations

import time
from math import isfinite
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet import tbuf
from pbonet.errors import ConfigError, ProtocolError
from pbonet.svar import now_ns

from . import field_paths
from ._numbers import Taker
from .cdr_template import Layout
from .message_types import HEADER, TRAJECTORY, nanoseconds, seconds
from .wire_format import Attachment, must_be_short

if TYPE_CHECKING:
    import zenoh
    from numpy.typing import DTypeLike, NDArray

    from .field_paths import Source
    from .message_types import MessageTypes
    from .repeated_warnings import Warnings
    from .topics_file import Subscribe

_NAMES: Final = ("name", "joint_names")
"""Fields of messages that name joints."""
_COLUMNS: Final = ("positions", "velocities", "accelerations")
_SHOWN: Final = 10
"""Numbers that a warning shows."""
_SENDERS: Final = 100
"""Senders of a topic whose numbers are kept."""
_LEARN_NS: Final = 100_000_000
"""Nanoseconds after which another layout of messages is learnt."""
_LEARNT: Final = 4096
"""Bytes of the longest message whose layout is learnt; that takes a time that grows
with its messages within."""
_LONG_AGO_NS: Final = 3600_000_000_000
_AHEAD_NS: Final = 100_000_000
"""Nanoseconds by which a header's stamp may be ahead of this machine's clock. By as
much a delay is hidden."""


class Selection:
    """Numbers of a message in the order in which a variable has them.

    Args:
        types: The types of messages.
        about: What the file says.
        where: The place, for errors.

    Raises:
        ConfigError: A type or field does not exist, or its size is not said.
    """

    def __init__(self, types: MessageTypes, about: Subscribe, where: str) -> None:
        types.must_have(about.type, where)
        self._joints = _Joints(about.joints)
        if not about.fields:
            raise ConfigError(
                "it is not said which numbers of the message are wanted",
                where=where,
                expected='fields = ["linear.x", "angular.z"]',
            )
        self._sources: list[Source] = [
            field_paths.source(leaf, len(about.joints), where)
            for path in about.fields
            for leaf in field_paths.leaves_of(types, about.type, path, where)
        ]
        if about.joints:
            _must_name_joints(types, about.type, where)
        self.form: DTypeLike = ("f8", (sum(one.size for one in self._sources),))
        """The type of a record of the link."""

    def read(self, message: Any, to: NDArray[np.float64]) -> None:  # noqa: ANN401
        """Copy the numbers of a message.

        Raises:
            ProtocolError: It has fewer, or not all joints.
        """
        order = self._joints.order(message)
        at = 0
        for one in self._sources:
            to[at : at + one.size] = field_paths.numbers(message, one, order)
            at += one.size

    def taker(
        self, types: MessageTypes, name: str, data: bytes, to: NDArray[np.float64]
    ) -> Taker | None:
        """Return what copies numbers of messages like this one without decoding them.

        None: its sender encodes otherwise than rosbags.
        """
        message = types.decode(name, data)
        order = self._joints.order(message)
        layout = Layout(types, name, data, message)
        if not layout.is_known:
            return None
        places = field_paths.slices(layout, message, self._sources, order)
        stamp = -1
        if _has_header(types, name):
            stamp = layout.place(message.header.stamp, "sec", "int32", None)
        return Taker(layout.mask, layout.rest, places, to, stamp)

    def must_be_finite(self, values: NDArray[np.float64]) -> None:
        """Refuse numbers that are not finite.

        Raises:
            ProtocolError: One is not.
        """
        if isfinite(values.dot(values)):  # which costs less than to ask for each
            return
        at = 0
        for one in self._sources:
            place = values[at : at + one.size]
            if not np.isfinite(place).all():
                raise ProtocolError(
                    f"{one.leaf.path} is not finite, and the message was not used",
                    got=" ".join(f"{value:g}" for value in place[:_SHOWN]),
                    remedy="its sender must send finite numbers, or nothing",
                )
            at += one.size


class Trajectory:
    """A JointTrajectory as rows of time, positions, velocities and accelerations.

    What a message does not give, and rows after its last point, are not a number. The
    goal is the number of that of an action, which is repeated while it is watched; 0:
    it is a message of a topic.

    Args:
        types: The types of messages.
        about: What the file says.
        where: The place, for errors.

    Raises:
        ConfigError: The joints are not said.
    """

    def __init__(self, types: MessageTypes, about: Subscribe, where: str) -> None:
        types.must_have(about.type, where)
        if not about.joints or about.fields:
            raise ConfigError(
                "a trajectory needs its joints, and no fields",
                where=where,
                expected='joints = ["joint1", "joint2"]',
            )
        self._joints = _Joints(about.joints)
        self._count = len(about.joints)
        rows = about.points, 1 + len(_COLUMNS) * self._count
        self.form: DTypeLike = np.dtype([("goal", "i8"), ("rows", "f8", rows)])
        """The type of a record of the link, as `ros_trajectory` has it."""

    def read(self, message: Any, record: NDArray[Any]) -> None:  # noqa: ANN401
        """Copy the points of a message.

        Raises:
            ProtocolError: It has too many points, or not all joints.
        """
        points, n, to = message.points, self._count, record["rows"]
        if len(points) > len(to):
            raise ProtocolError(
                "the trajectory has too many points",
                expected=f"at most {len(to)}",
                got=f"{len(points)}",
                remedy="set `points` of the topic, and POINTS of ros_trajectory",
            )
        record["goal"], to[:] = 0, np.nan
        order = self._joints.order(message) if points else None
        for row, point in zip(to, points, strict=False):
            row[0] = seconds(point.time_from_start)
            for k, column in enumerate(_COLUMNS):
                values = getattr(point, column)
                if len(values):
                    row[1 + k * n : 1 + (k + 1) * n] = _ordered(values, order, column)


def _ordered(values: Any, order: NDArray[np.intp] | None, column: str) -> Any:  # noqa: ANN401
    if order is None or len(values) <= int(order.max()):
        raise ProtocolError(
            f"a point of the trajectory has too few {column}", got=f"{len(values)}"
        )
    return values[order]


class _Joints:
    """Where joints stand in messages.

    Args:
        wanted: Their names, in the order of the variable.
    """

    def __init__(self, wanted: list[str]) -> None:
        self._wanted = wanted
        self._last: list[str] = []
        self._order: NDArray[np.intp] | None = None

    def order(self, message: Any) -> NDArray[np.intp] | None:  # noqa: ANN401
        """Return the place of each joint in a message; None if no joint was named.

        Raises:
            ProtocolError: The message does not have all joints.
        """
        if not self._wanted:
            return None
        names: list[str] = next(
            list(getattr(message, one)) for one in _NAMES if hasattr(message, one)
        )
        if self._order is None or names != self._last:
            places = {name: place for place, name in enumerate(names)}
            missing = [name for name in self._wanted if name not in places]
            if missing:
                raise ProtocolError(
                    f"the message has no joint {missing[0]}",
                    expected=" ".join(self._wanted),
                    got=" ".join(names[:20]),
                )
            self._order = np.array([places[name] for name in self._wanted], np.intp)
            self._last = names
        return self._order


def _must_name_joints(types: MessageTypes, name: str, where: str) -> None:
    if not any(field.name in _NAMES for field in types.fields(name)):
        raise ConfigError(
            f"{name} has no names of joints",
            where=where,
            expected="JointState, or another message with `name` or `joint_names`",
            remedy="remove `joints`, and say which elements: position[0:6]",
        )


def _has_header(types: MessageTypes, name: str) -> bool:
    return any(
        (one.name, one.type, one.size) == ("header", HEADER, None)
        for one in types.fields(name)
    )


Reading = Selection | Trajectory


def reading(types: MessageTypes, about: Subscribe, where: str) -> Reading:
    """Return how a topic's messages become records.

    Raises:
        ConfigError: A type or field does not exist, or a size is not said.
    """
    kind = Trajectory if about.type == TRAJECTORY else Selection
    by_header = about.stamp == "header" and types.has(about.type)
    if by_header and not _has_header(types, about.type):
        raise ConfigError(
            f"{about.type} has no header with a stamp",
            where=where,
            expected="stamp = 'arrival'",
            got="stamp = 'header'",
        )
    return kind(types, about, where)


class Incoming:
    """One topic with its link.

    Args:
        types: The types of messages.
        about: What the file says.
        record: How messages become records.
        warnings: What a user should know.

    Raises:
        XmError: The link has another writer, or its name cannot be one.
    """

    def __init__(
        self,
        types: MessageTypes,
        about: Subscribe,
        record: Reading,
        warnings: Warnings,
    ) -> None:
        self.about, self._types, self._record = about, types, record
        self._warnings = warnings
        self._last: dict[bytes, int] = {}
        self._by_header = about.stamp == "header"
        self._taker: Taker | None = None
        self._learn_ns = 0
        self.lost = 0
        """Messages that came faster than they were read, or were lost on the way."""
        self._writer = tbuf.Writer(about.link, record.form)

    def close(self) -> None:
        """Detach from the link."""
        self._writer.close()

    def take(self, sample: zenoh.Sample, arrived: int) -> None:
        """Write a message to the link.

        Args:
            sample: The message.
            arrived: When it came, by `now_ns`; it may have waited since.

        Raises:
            ProtocolError: It is too long, or no such message.
        """
        payload, attachment = sample.payload, sample.attachment  # each a new object
        must_be_short(len(payload))
        sent = None
        if attachment is not None:
            sent = Attachment.unpack(attachment.to_bytes())
        try:
            stamp_ns = self._read(payload.to_bytes())
            self._writer.write(arrived - self._age(stamp_ns, arrived))
        finally:  # after the reader was woken
            if sent is not None:
                self._count(sent)

    def _read(self, data: bytes) -> int:
        """Copy the numbers of a message; return its header's stamp.

        A message with the layout of an earlier one need not be decoded.
        """
        taker = self._taker
        if taker is not None and taker.take(data):
            return taker.stamp_ns
        record, values = self._record, self._writer.value
        message = self._types.decode(self.about.type, data)
        record.read(message, values)
        if isinstance(record, Selection):
            record.must_be_finite(values)
            self._learn(record, data)
        return nanoseconds(message.header.stamp) if self._by_header else 0

    def _learn(self, record: Selection, data: bytes) -> None:
        """Learn the layout of a message, but not too often, as layouts may change."""
        now = now_ns()
        if len(data) <= _LEARNT and now > self._learn_ns:
            self._learn_ns = now + _LEARN_NS
            self._taker = record.taker(
                self._types, self.about.type, data, self._writer.value
            )

    def _age(self, stamp_ns: int, arrived: int) -> int:
        """Return how old a message's content was at its arrival, in nanoseconds."""
        if not self._by_header:
            return 0
        waited = now_ns() - arrived
        age = time.time_ns() - waited - stamp_ns
        if not -_AHEAD_NS < age < _LONG_AGO_NS:
            raise ProtocolError(
                "the header's stamp is not of this time, and the message was not used",
                expected="nanoseconds since 1970 by a clock that agrees with this one",
                got=f"{abs(age) * 1e-9:.1f} s {'ago' if age > 0 else 'ahead'}",
                remedy="synchronize the clocks, or say stamp = 'arrival'",
            )
        return max(age, 0)

    def _count(self, attachment: Attachment) -> None:
        """Count what was not read, and tell of it."""
        last = self._last.get(attachment.gid)
        if len(self._last) >= _SENDERS:
            self._last.clear()
        self._last[attachment.gid] = attachment.number
        if last is not None and attachment.number > last + 1:
            self.lost += attachment.number - last - 1
            self._warnings.warn(
                self.about.topic,
                f"messages come faster than max_hz = {self.about.max_hz:g} or are lost",
                f": {self.lost} were not read; the newest are",
            )
