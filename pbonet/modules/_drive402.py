"""One motor drive on a CAN bus: CANopen, and the state machine of CiA 402.

It is spoken with once in each cycle of a task, and nothing waits. First its objects are
set (SDO), then it is started (NMT), then it is enabled step by step; from there on each
cycle sends it a control word and a target, and it sends position, speed and torque.
"""

from __future__ import annotations

import struct
from enum import Enum, StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from pbonet.io.drivers import Frame

from . import _canopen as canopen
from ._canopen import Object

if TYPE_CHECKING:
    from collections.abc import Iterator

ANSWER: Final = 0.5
"""Seconds in which a node answers."""
CLIMB: Final = 3.0
"""Seconds in which a drive is enabled, with its brake and the reset of a fault."""
TARGET, MEASURED, MORE = 0x200, 0x180, 0x280
"""Process data of a node: to it, and from it the first and the second ones."""
QUICK_STOP, RESET = 0x02, 0x80
"""Control words."""
_SHOWN: Final = struct.Struct("<Hi")
_MORE: Final = struct.Struct("<ihb")
_OFF: Final = 0x80000000
_NO_REMOTE: Final = 0x40000000


class State(StrEnum):
    """States of a drive."""

    NOT_READY = "not ready to switch on"
    DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    STOPPING = "quick stop active"
    REACTING = "fault reaction active"
    FAULT = "fault"


_STATES: Final = (
    (0x4F, 0x00, State.NOT_READY),
    (0x4F, 0x40, State.DISABLED),
    (0x6F, 0x21, State.READY),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.ENABLED),
    (0x6F, 0x07, State.STOPPING),
    (0x4F, 0x0F, State.REACTING),
    (0x4F, 0x08, State.FAULT),
)
"""Bits of the status word that count, their values, and the state."""
_UPWARDS: Final = {
    State.NOT_READY: 0x00,
    State.DISABLED: 0x06,
    State.READY: 0x07,
    State.SWITCHED_ON: 0x0F,
    State.ENABLED: 0x0F,
    State.STOPPING: 0x00,
    State.REACTING: 0x00,
    State.FAULT: 0x00,
}
"""The control word that brings a drive one step towards `State.ENABLED`."""


def state_of(status: int) -> State:
    """Return the state that a status word says."""
    for mask, value, state in _STATES:
        if status & mask == value:
            return state
    return State.NOT_READY


class Mode(Enum):
    """Cyclic modes: number, object of the target, its bytes and their form."""

    POSITION = 8, 0x607A, 4, "<Hi"
    SPEED = 9, 0x60FF, 4, "<Hi"
    TORQUE = 10, 0x6071, 2, "<Hh"


class Bus(NamedTuple):
    """The settings that all drives of a bus have in common."""

    mode: Mode
    period_ms: int
    """Of the task."""
    beat: float
    """Seconds after which either side counts the other one as lost."""
    master: int
    """The task's own number on the bus."""


class _Phase(Enum):
    """How far a drive is."""

    OBJECTS = "its objects are set"
    START = "it is started"
    ON = "it gets process data"


class Drive:
    """One drive.

    Args:
        node: Its number on the bus.
        bus: What it has in common with others.

    Attributes:
        position: In its own units, as it said last; so the next ones.
        speed: See there.
        torque: In thousandths of the rated torque.
        measured_ns: When that came; 0: never.
        fault: Why it must not go on; empty if nothing is wrong.
        follows: Whether it is enabled, and follows its target.
    """

    def __init__(self, node: int, bus: Bus) -> None:
        self.node, self._bus = node, bus
        self._form = struct.Struct(bus.mode.value[3])
        self.position = self.speed = self.torque = 0
        self.begin(0, may_reset=False)

    def begin(self, now: int, *, may_reset: bool) -> None:
        """Begin from the start, whatever was before.

        Args:
            now: Nanoseconds.
            may_reset: Whether a fault of the drive may be reset, once.
        """
        self.fault, self.follows, self.measured_ns = "", False, 0
        self._phase, self._may_reset = _Phase.OBJECTS, may_reset
        self._objects: Iterator[Object] = iter(self._settings())
        self._asked: Object | None = None
        self._since = self._heard = now
        self._status, self._shown_mode = 0, 0
        self._operational, self._is_told = False, False
        self._code, self._control, self._begun = 0, -1, now

    def take(self, frame: Frame, now: int) -> None:
        """Take a frame that came from the drive."""
        kind, data = frame.id - self.node, frame.data
        if kind == MEASURED and len(data) >= _SHOWN.size:
            self._status, self.position = _SHOWN.unpack_from(data)
            self.measured_ns = now
            # Only an operational node sends them; its next heartbeat may be far.
            self._operational |= self._phase is _Phase.START
        elif kind == MORE and len(data) >= _MORE.size:
            self.speed, self.torque, self._shown_mode = _MORE.unpack_from(data)
        elif kind == canopen.HEARTBEAT and data:
            self._take_beat(data[0] & 0x7F, now)
        elif kind == canopen.SDO_ANSWER:
            self._take_answer(data, now)
        elif kind == canopen.EMERGENCY and len(data) > 1:
            self._code = int.from_bytes(data[:2], "little") or self._code

    def step(self, now: int, target: int, *, run: bool) -> list[Frame]:
        """Return the frames for the drive in this cycle.

        Args:
            now: Nanoseconds.
            target: In its own units; used while it follows.
            run: Whether it is to be enabled; else it stops quickly.
        """
        if self._phase is _Phase.OBJECTS:
            return self._set_objects(now)
        if self._phase is _Phase.START:
            if self._operational:
                self._phase, self._since, self._begun = _Phase.ON, now, now
            elif now - self._since > ANSWER * 1e9:
                self._fail("does not become operational")
            return []
        self._watch(now)
        self._control = QUICK_STOP if self.fault else self._next(now, run=run)
        return [self._data(self._control, target)]

    def stop(self) -> Frame:
        """Return the frame that stops the drive quickly; its target does not count."""
        return self._data(QUICK_STOP, 0)

    def leave(self) -> Frame:
        """Return the frame by which the drive does without the task's heartbeats."""
        return canopen.write(self.node, Object(0x1016, 1, 0, 4))

    def rest(self) -> int:
        """Return the target with which the drive stays where it is."""
        return self.position if self._bus.mode is Mode.POSITION else 0

    # -- inside ------------------------------------------------------------------------

    def _data(self, control: int, target: int) -> Frame:
        return Frame(TARGET + self.node, self._form.pack(control, target))

    def _fail(self, what: str) -> None:
        self.fault = self.fault or f"drive {self.node} {what}"

    def _take_beat(self, state: int, now: int) -> None:
        self._heard = now
        self._operational = state == canopen.OPERATIONAL
        if self._phase is _Phase.ON and not self._operational:
            was = "has started again" if state == canopen.BOOT_UP else "has stopped"
            self._fail(f"{was} by itself (its state is {state:#04x})")

    def _take_answer(self, data: bytes, now: int) -> None:
        asked = self._asked
        code = None if asked is None else canopen.refusal(data, asked)
        if asked is None or code is None:
            return
        if code and not (asked.optional and code == canopen.NO_OBJECT):
            self._fail(f"refuses the object {asked} (abort code {code:08X}h)")
        self._asked, self._since = None, now

    def _set_objects(self, now: int) -> list[Frame]:
        """Set one object after the other; the mapping of data needs pre-operational."""
        if self._asked is not None:
            if now - self._since > ANSWER * 1e9:
                self._fail(f"does not answer (asked for the object {self._asked})")
            return []
        frames: list[Frame] = []
        if not self._is_told:
            frames.append(canopen.command(self.node, canopen.PRE_OPERATIONAL))
            self._is_told = True
        self._asked, self._since = next(self._objects, None), now
        if self._asked is None:
            self._phase = _Phase.START
            return [canopen.command(self.node, canopen.START)]
        return [*frames, canopen.write(self.node, self._asked)]

    def _watch(self, now: int) -> None:
        """See whether the drive is there, and sends what it measures."""
        limit = self._bus.beat * 1e9
        if now - self._heard > limit:
            self._fail(f"gives no sign of life for {self._bus.beat:g} s")
        elif now - max(self.measured_ns, self._begun) > limit:
            self._fail(f"sends no position for {self._bus.beat:g} s")

    def _next(self, now: int, *, run: bool) -> int:
        """Return the next control word."""
        state = state_of(self._status)
        if state in {State.FAULT, State.REACTING} and not self._may_reset:
            code = f" (error code {self._code:04X}h)" if self._code else ""
            self._fail(f"has a fault{code}")
            return QUICK_STOP
        if state is not State.FAULT and self._control == RESET:
            self._may_reset = False
        if not run:
            self.follows, self._since = False, now
            return QUICK_STOP
        if state is State.ENABLED and self._shown_mode == self._bus.mode.value[0]:
            self.follows = True
        elif self.follows:
            self._fail(f"is no longer enabled: its state is {state}")
            return QUICK_STOP
        elif now - self._since > CLIMB * 1e9:
            self._fail(f"is not enabled in {CLIMB:g} s: its state is {state}")
            return QUICK_STOP
        if state is State.FAULT and self._control in {0, RESET}:
            return RESET  # its rising edge is what counts
        return _UPWARDS[state]

    def _settings(self) -> tuple[Object, ...]:
        """Return the objects of the drive, in the order in which they are set."""
        node, bus = self.node, self._bus
        number, target, size, _ = bus.mode.value
        beat_ms = round(1000 * bus.beat)
        first, second = MEASURED + node, MORE + node
        period = min(bus.period_ms, 255)
        return (
            *_process_data(0x1400, TARGET + node, (0x6040, 2), (target, size)),
            *_process_data(0x1800, first, (0x6041, 2), (0x6064, 4), every=period),
            *_process_data(
                0x1801, second, (0x606C, 4), (0x6077, 2), (0x6061, 1), every=period
            ),
            Object(0x1017, 0, max(beat_ms // 4, 1), 2),
            Object(0x1016, 1, bus.master << 16 | beat_ms, 4),
            Object(0x6007, 0, 3, 2),  # without the task it stops quickly
            Object(0x605A, 0, 2, 2),  # on its ramp, and is then disabled
            Object(0x6060, 0, number, 1),
            Object(0x60C2, 1, period, 1, optional=True),
            Object(0x60C2, 2, -3, 1, optional=True),
        )


def _process_data(
    index: int, identity: int, *parts: tuple[int, int], every: int = 0
) -> list[Object]:
    """Return the objects that say what process data of a node have.

    Args:
        index: Of their communication; their mapping is 200h behind.
        identity: Of the frame.
        parts: Objects and their bytes.
        every: Milliseconds from one frame to the next; 0: they are received.
    """
    flag, mapping = _NO_REMOTE if every else 0, index + 0x200
    found = [
        Object(index, 1, _OFF | flag | identity, 4),
        Object(mapping, 0, 0, 1),
        *(
            Object(mapping, k + 1, one << 16 | 8 * size, 4)
            for k, (one, size) in enumerate(parts)
        ),
        Object(mapping, 0, len(parts), 1),
        Object(index, 2, 255, 1),  # at once, by no SYNC
    ]
    if every:
        found.append(Object(index, 5, every, 2))
    return [*found, Object(index, 1, flag | identity, 4)]
