"""Variables of the table as topics, by a thread that asks nothing of any task."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import numpy as np

from pbonet.errors import (
    ConfigError,
    PbonetError,
    ProtocolError,
    SvarError,
    SvarMissingError,
)
from pbonet.svar import Flags, Freshness, Table, Watch, now_ns

from . import field_paths
from ._numbers import Filler
from .cdr_template import Template
from .field_paths import Part
from .message_types import HEADER
from .topics_file import JOINT_STATE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable
    from pbonet.svar import LocalTable

    from .field_paths import Leaf, Share
    from .message_types import MessageTypes
    from .repeated_warnings import Warnings
    from .ros_node import Publisher
    from .topics_file import Plain, Publish

_GLANCE_NS: Final = 1_000_000
"""Nanoseconds between checks of a table that is not expected to change."""
_NEAR_NS: Final = 20_000
"""The same while a commit is expected."""
_AWAKE_NS: Final = (80_000, 20_000) if len(os.sched_getaffinity(0)) > 1 else (0, 0)
"""Nanoseconds before and after the time when a commit is expected in which the thread
does not sleep, as to be woken takes longer than to copy. Commits come a little before
that time, as it is the mean of when they were seen. Not on a machine of one core.
"""
_EARLY: Final = 0.1
"""Share of a period by which a commit is expected early."""
_LATE: Final = 1.0
"""Share of a period for which one that is late is expected."""
_PHASE, _RATE = 0.1, 0.005
"""Least shares of the lateness of a commit by which the next one is expected later, and
by which the period grows."""
_REST_NS: Final = 2_000_000
"""Nanoseconds for which the thread sleeps at most without a look at the table."""
_LOST, _SOME = 0.5, 5
"""Share of a period by which a commit is no longer the expected one, and the number of
commits that count from there on. So many in a row, and the period is another one."""
_SOON: Final = 0.95
"""Share of the shortest time between two messages after which one may be sent."""
_LONGEST_NS: Final = 200_000_000
"""Nanoseconds until the thread looks whether the table is still there."""
_AGAIN: Final = 0.2
_PAUSED: Final = "it is paused: a variable is stale, or was never written"
_NO_TABLE: Final = "the subsystem is not open on this machine; it is waited for"
_STALE: Final = int(Flags.COPY_STALE)
"""An integer, as to combine a flag with one takes longer than to encode a message."""
_BAD: Final = int(Flags.COPY_LOST | Flags.TABLE_OVERWRITTEN)


class Filling:
    """A message that is filled with variables.

    Args:
        types: The types of messages.
        about: What the file says.
        variables: The variables of the table.
        where: The place, for errors.

    Raises:
        ConfigError: A type, field or variable does not exist, or they do not fit.
    """

    def __init__(
        self,
        types: MessageTypes,
        about: Publish,
        variables: dict[str, Variable],
        where: str,
    ) -> None:
        types.must_have(about.type, where)
        if not about.fields:
            raise ConfigError(
                "no variable is published",
                where=where,
                expected='fields = { FIELD = "VARIABLE" }',
            )
        self.type = about.type
        self._message: Any = types.new(about.type)
        plan: list[Part] = []
        for path, text in about.fields.items():
            share = field_paths.share_of(text, variables, where)
            leaves = field_paths.leaves_of(types, about.type, path, where)
            plan += _shared(leaves, share, variables[share.variable], where)
        field_paths.must_be_whole(plan, about.constants, where)
        for one in plan:
            field_paths.grow(types, self._message, one.leaf)
        for path, value in about.constants.items():
            self._set(path, value, where)
        self.variables = sorted({one.share.variable for one in plan})
        stamps = list(_headers(types, about.type, self._message))
        for header in stamps:
            self._must_not_give(header.stamp, plan, where)
            header.frame_id = about.frame or header.frame_id
            header.stamp.sec = 0  # its place is found by what stands there
        for one in plan:
            field_paths.clear(self._message, one)
        _must_be_of_one_size(about.type, self._message, where)
        try:
            template = Template(types, about.type, self._message)
        except ProtocolError as error:
            raise ConfigError(
                error.what,
                where=where,
                expected=error.expected,
                got=error.got,
                remedy=error.remedy,
            ) from None
        self._message_bytes = template.bytes
        self._numbers = [
            (*field_paths.place(template, self._message, one), one.share, one.leaf)
            for one in plan
        ]
        self._stamps = [
            template.place(header.stamp, "sec", "int32", None) for header in stamps
        ]

    def _must_not_give(self, stamp: Any, plan: list[Part], where: str) -> None:  # noqa: ANN401
        """Refuse a header's stamp that the file gives, as the bridge sets it."""
        for one in plan:
            if field_paths.owner_of(self._message, one.leaf)[0] is stamp:
                raise ConfigError(
                    "the stamp of a header is no field to give",
                    where=where,
                    expected="other fields; the stamp is the time of the variables",
                    got=one.leaf.path,
                    remedy="remove it",
                )

    def _set(self, path: str, value: Plain | list[Plain], where: str) -> None:
        """Set a field that stays as it is."""
        *way, last = path.split(".")
        owner: Any = self._message
        try:
            for part in way:
                name, _, index = part.partition("[")
                owner = getattr(owner, name)
                owner = owner[int(index.removesuffix("]"))] if index else owner
            before = getattr(owner, last)
            setattr(owner, last, _as(before, value))
        except (AttributeError, IndexError, TypeError, ValueError):
            raise ConfigError(
                f"the constant {path} cannot be set",
                where=where,
                expected=f"a field of {self.type}, and a value of its type",
                got=repr(value),
            ) from None

    def of(self, values: dict[str, NDArray[Any]]) -> Message:
        """Return the message of these values, whatever they are when it is encoded.

        Args:
            values: The values of `variables`.
        """
        casts: list[tuple[NDArray[Any], NDArray[Any], Leaf]] = []
        parts: list[tuple[int, NDArray[Any]]] = []
        for place, dtype, share, leaf in self._numbers:
            given = values[share.variable][share.first : share.end]
            numbers = given
            if given.dtype is not dtype:
                numbers = np.empty(given.shape, dtype)
                casts.append((given, numbers, leaf))
            parts.append((place, numbers))
        return Message(Filler(self._message_bytes, parts, self._stamps), casts)


class Message(NamedTuple):
    """A message of values that change."""

    filler: Filler
    casts: list[tuple[NDArray[Any], NDArray[Any], Leaf]]
    """Values of another type than their fields, and the numbers that they become."""

    def encode(self, stamp_ns: int) -> bytes:
        """Return it with the values as they are now, in CDR.

        Args:
            stamp_ns: When they were made, nanoseconds since 1970.

        Raises:
            ProtocolError: A number does not fit its field.
        """
        for given, numbers, leaf in self.casts:
            numbers[:] = field_paths.cast(given, numbers.dtype, leaf)
        return self.filler.fill(stamp_ns)


def _shared(
    leaves: Sequence[Leaf], share: Share, variable: Variable, where: str
) -> list[Part]:
    """Return which elements of a variable go to which number of a message."""
    if variable.dtype[0] == "V":
        raise ConfigError(
            f"{variable.name} is a struct, not numbers",
            where=where,
            remedy="publish variables of numbers",
        )
    found: list[Part] = []
    first, size = share.first, share.end - share.first
    widths = [field_paths.width(leaf) for leaf in leaves]
    need = sum(one or 0 for one in widths)
    if None in widths and len(leaves) == 1:
        widths = [size]
    elif need != size or None in widths:
        raise ConfigError(
            f"{variable.name} does not fit {leaves[0].path}",
            where=where,
            expected=f"{need} elements",
            got=f"{size}",
            remedy=f"name some, as {variable.name}[0:{need}], or other fields",
        )
    for leaf, one in zip(leaves, widths, strict=True):
        field_paths.must_fit(leaf, variable, where)
        end = first + (one or 0)
        found.append(Part(leaf, share._replace(first=first, end=end)))
        first = end
    return found


def _must_be_of_one_size(name: str, message: Any, where: str) -> None:  # noqa: ANN401
    """Refuse a JointState with lists of several sizes, which no node of ROS uses."""
    if name != JOINT_STATE:
        return
    lists = ("name", "position", "velocity", "effort")
    sizes = {one: len(getattr(message, one)) for one in lists}
    if len({size for size in sizes.values() if size}) > 1:
        raise ConfigError(
            "its lists differ in size",
            where=where,
            expected="one size; a list may also be empty",
            got=" ".join(f"{one}: {size}" for one, size in sizes.items()),
            remedy="name all joints under `constants`, and only those",
        )


def _as(before: object, value: Plain | list[Plain]) -> object:
    """Return a constant as its field has it."""
    if isinstance(before, np.ndarray):
        array = cast("NDArray[Any]", before)
        return np.array(value, array.dtype)
    if isinstance(before, list):
        if not (isinstance(value, list) and all(isinstance(v, str) for v in value)):
            raise TypeError
        return value
    if isinstance(value, list) or isinstance(before, str) != isinstance(value, str):
        raise TypeError
    kind: Any = type(before)
    return kind(value)


def _headers(types: MessageTypes, name: str, message: Any) -> Iterable[Any]:  # noqa: ANN401
    """Yield the headers in a message."""
    if name == HEADER:
        yield message
        return
    for field in types.fields(name):
        if field.nested:
            inner = getattr(message, field.name)
            for one in [inner] if field.size is None else inner:
                yield from _headers(types, field.type, one)


class Outgoing:
    """One topic with the variables that it is made of.

    Args:
        filling: The message.
        publisher: Where it goes.
        max_hz: The highest rate, Hz.
        warnings: What a user should know.
    """

    def __init__(
        self, filling: Filling, publisher: Publisher, max_hz: float, warnings: Warnings
    ) -> None:
        self.filling, self.publisher, self._warnings = filling, publisher, warnings
        self._pause_ns = int(1e9 / max_hz * _SOON)
        self._local: LocalTable | None = None
        self._message: Message | None = None
        self._places: list[int] = []
        self._sent: list[tuple[int, int]] = []
        self._paused = False
        self.copied: list[tuple[int, int]] = []
        """Registers that were copied last, and the number of the commit of each."""
        self.due_ns = 0
        """When it may be published again."""

    def attach(self, table: Table) -> None:
        """Read this table from now on."""
        names = self.filling.variables
        self._local = local = table.local("ros2", os.getpid(), invar=names)
        self._places = [table.index(name) for name in names]
        local.keep_fresh({place: Freshness() for place in self._places})
        self._message = self.filling.of({name: local.array(name) for name in names})
        self._sent = self.copied = []

    @property
    def behind(self) -> bool:
        """Whether it has a commit that was not published yet."""
        return self._sent != self.copied

    def prepare(self) -> None:
        """Encode for nothing: code that has not run for long takes twice the time."""
        if self._sent and self._message is not None:
            with suppress(PbonetError):  # `turn` warns of it
                self._message.encode(0)

    def turn(self, now: int) -> None:
        """Publish the variables if one has changed, none is too old, and it is time."""
        local, message = self._local, self._message
        if local is None or message is None or local.copy_in() & _BAD:
            return
        self.copied = local.pairs
        if not self.behind or now < self.due_ns:
            return
        self._sent = self.copied
        ages_ns = [local.age_ns(place) for place in self._places]
        if local.flags & _STALE or min(ages_ns) < 0:
            self._warnings.warn(self.publisher.end.name, _PAUSED)
            self._paused = True
            return
        if self._paused:
            self._warnings.over(self.publisher.end.name, _PAUSED)
            self._paused = False
        self.due_ns = now + self._pause_ns
        stamp_ns = time.time_ns() - max(ages_ns)
        self.publisher.put(message.encode(stamp_ns), stamp_ns)


class TablePublisher:
    """Publishes the table of a subsystem, as long and as often as there is one.

    Args:
        name: The table's name.
        layout: Its layout.
        outgoing: The topics.
        warnings: What a user should know.
    """

    def __init__(
        self, name: str, layout: str, outgoing: list[Outgoing], warnings: Warnings
    ) -> None:
        self._name, self._layout = name, layout
        self._outgoing, self._warnings = outgoing, warnings
        self._table: Table | None = None
        self._watch = Watch()
        self._ended = threading.Event()
        self._period_ns = 0.0
        self._last_ns = 0.0
        self._seen_ns = self._count = self._strays = 0
        self._heads: dict[int, int] = {}
        self._generation = -1
        self._thread = threading.Thread(
            target=self._work, name="ros topics", daemon=True
        )

    def start(self) -> None:
        """Publish from now on."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._ended.set()
        self._watch.ring()
        if self._thread.is_alive():
            self._thread.join()

    def _work(self) -> None:
        while not self._ended.is_set():
            try:
                if self._table is None:
                    self._attach()
                else:
                    self._turn(self._table)
            except SvarMissingError:
                self._warnings.warn(self._name, _NO_TABLE)
                self._ended.wait(_AGAIN)
            except SvarError as error:
                self._warnings.warn_of(self._name, error)
                self._leave()
                self._ended.wait(_AGAIN)
            except Exception as error:  # noqa: BLE001 - other topics go on
                self._warnings.failed(self._name, error)
                self._leave()
                self._ended.wait(_AGAIN)
        self._leave()

    def _attach(self) -> None:
        self._table = Table.attach(self._name, layout=self._layout)
        self._generation = -1
        for one in self._outgoing:
            one.attach(self._table)
        self._warnings.over(self._name, _NO_TABLE)

    def _leave(self) -> None:
        if self._table is not None:
            self._table.close()
            self._table = None

    def _turn(self, table: Table) -> None:
        """Wait until something has changed, and publish it."""
        before = self._numbers()
        moved = self._sleep(table, before)
        now = now_ns()
        for one in self._outgoing:
            self._publish(one, now)
        if moved:
            self._rest(now)
            steps = [n - before.get(uid, n) for uid, n in self._numbers().items()]
            self._measure(now, max(steps, default=0))
        elif not _is_there(table):
            self._leave()

    def _rest(self, now: int) -> None:
        """Sleep until shortly before the next commit, but not for long.

        Another task may commit before. What is left to do is done after that: zenoh's
        threads need the core now.
        """
        period = self._period_ns
        if period and not any(one.behind for one in self._outgoing):
            gone = max(int((now - self._last_ns) / period), 1)
            until = self._last_ns + (gone + 1 - _EARLY) * period
            left_ns = min(until - now_ns(), _REST_NS)
            time.sleep(max(left_ns, 0.0) * 1e-9)

    def _publish(self, one: Outgoing, now: int) -> None:
        """Publish a topic if it is time; the others go on whatever it does."""
        try:
            one.turn(now)
        except SvarError:
            raise
        except PbonetError as error:
            self._warnings.warn_of(one.publisher.end.name, error)
        except Exception as error:  # noqa: BLE001 - see above
            self._warnings.failed(one.publisher.end.name, error)

    def _numbers(self) -> dict[int, int]:
        """Return the number of the newest commit that was copied, by register."""
        found: dict[int, int] = {}
        for one in self._outgoing:
            for uid, number in one.copied:
                found[uid] = max(number, found.get(uid, 0))
        return found

    def _sleep(self, table: Table, known: dict[int, int]) -> bool:
        """Sleep until a commit; where one is expected, look closely.

        Returns:
            Whether there was one.
        """
        arena = table.arena
        if table.generation != self._generation:
            self._generation = table.generation
            self._heads = {one.uid: one.index for one in table.registers()}
        self._watch.forget()
        heads = [
            (self._heads[uid], n) for uid, n in known.items() if uid in self._heads
        ]
        self._watch.add(arena, self._generation, arena.changes, heads)
        now = now_ns()
        due = [one.due_ns for one in self._outgoing if one.behind]
        until = min([now + _LONGEST_NS, *due])
        expected = self._last_ns + self._period_ns
        early = _EARLY * self._period_ns
        share = min(early / max(_AWAKE_NS[0], 1), 1.0)  # less of a short period
        is_regular = self._count > _SOME or early > _GLANCE_NS
        phases = (
            (expected - early, _GLANCE_NS if is_regular else 2 * _NEAR_NS),
            (expected - share * _AWAKE_NS[0], 2 * _NEAR_NS),
            (expected + share * _AWAKE_NS[1], 0),
            (expected + _LATE * self._period_ns, _NEAR_NS),
            (until, _GLANCE_NS),
        )
        for end, pause_ns in phases:
            if not pause_ns:
                self._prepare()
            if self._watch.sleep(round(min(end, until)), pause_ns):
                return True
        return False

    def _prepare(self) -> None:
        """Do for nothing what a commit that comes at any moment needs."""
        if self._period_ns:
            for one in self._outgoing:
                one.prepare()

    def _measure(self, now: int, steps: int) -> None:
        """Take note of some commits, to expect the next one.

        A straight line through their times, which forgets old ones slowly; one that is
        seen late moves it little.
        """
        since, self._seen_ns = now - self._seen_ns, now
        known = steps and self._period_ns and self._strays <= _SOME
        if since > _LONGEST_NS or not known:
            regular = 0 < since < _LONGEST_NS and steps > 0
            self._period_ns = since / steps if regular else 0.0
            self._last_ns, self._count, self._strays = float(now), 1, 0
            return
        self._count = k = self._count + 1
        expected = self._last_ns + steps * self._period_ns
        late = now - expected
        if abs(late) > _LOST * self._period_ns:  # a pause, or another task
            self._last_ns, self._count = float(now), _SOME
            self._strays += 1
            return
        self._strays = 0
        self._last_ns = expected + late * max(_PHASE, (4 * k - 2) / (k * k + k))
        self._period_ns += late * max(_RATE, 6 / (k * k + k)) / steps


def _is_there(table: Table) -> bool:
    """Return whether a table's file is still that of its name."""
    try:
        return table.path.stat().st_ino == os.fstat(table.arena.fileno).st_ino
    except OSError:
        return False


def fillings(
    types: MessageTypes,
    wanted: Iterable[Publish],
    variables: dict[str, Variable],
    where: str,
) -> list[tuple[Publish, Filling]]:
    """Return the messages that a file names.

    Raises:
        ConfigError: A type, field or variable does not exist, or they do not fit.
    """
    return [
        (one, Filling(types, one, variables, f"{where}: {one.topic}")) for one in wanted
    ]
