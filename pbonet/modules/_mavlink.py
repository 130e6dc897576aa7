"""Shared by the MAVLink modules: their link, commands with retries, and set-points.

A task has one link. Its owner is `mav_vehicle` or `mav_ground`, which alone polls it;
other modules speak over it as parts of the same task (COMBINE), after its owner.
"""

from __future__ import annotations

from math import cos, isfinite, sin
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pbonet.errors import DeviceError, ParameterError
from pbonet.io import MavLink

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet import TaskContext, Vector

NOTHING, ATTITUDE, POSITION = 0, 82, 84
"""Kinds of set-points, the first of their 13 elements, named by their messages.

The second is the type mask, and eleven values follow. POSITION: x y z vx vy vz ax ay az
yaw yaw-rate. ATTITUDE: q (w x y z), three rates, thrust.
"""
X, V, ACC = 0x007, 0x038, 0x1C0
"""Bits of a position's type mask: set, the value does not count."""
YAW, YAW_RATE = 0x400, 0x800
RATES = 0x07
"""Bits of an attitude's type mask: the three rates."""
LOCAL_NED, BODY = 1, (8, 12)
"""Frames of a position target; in those of the body x is ahead and y to the right."""
GCS = 6
"""The type of a ground station in its heartbeat."""


def take_link(task: TaskContext, link: MavLink) -> MavLink:
    """Make a link that of the task.

    Raises:
        ParameterError: It has one.
    """
    if "mavlink" in task.shared:
        raise ParameterError(
            "two parts of one task own a MAVLink link",
            where=task.name,
            remedy="combine one of mav_vehicle and mav_ground",
        )
    task.shared["mavlink"] = link
    return link


def link_of(task: TaskContext) -> MavLink:
    """Return the link of the task.

    Raises:
        DeviceError: No part before this one has one.
    """
    link = task.shared.get("mavlink")
    if not isinstance(link, MavLink):
        raise DeviceError(
            "this module speaks over the link of its task, which has none",
            where=task.name,
            expected="COMBINE with mav_vehicle first, as in mav_craft.rmod",
            remedy="combine it with mav_vehicle, and name that before it",
        )
    return link


class Owner:
    """Polls the link of a task once a cycle, and says what is wrong with it.

    Args:
        task: The task.
        link: Its link.
    """

    def __init__(self, task: TaskContext, link: MavLink) -> None:
        self.link = take_link(task, link)
        self._task = task
        self._faulty = False
        self._foreign: set[int] = set()
        self._bad = 0

    def poll(self) -> None:
        """Receive; warn of a lost link, and of systems that do not belong here."""
        link = self.link
        link.poll(self._task.now)
        if link.fault and not self._faulty:
            self._task.warn(f"no MAVLink link: {link.fault}")
        self._faulty = link.fault is not None
        if len(link.foreign) > len(self._foreign):
            for system in link.foreign.keys() - self._foreign:
                self._task.warn(
                    f"system {system} on {link.address} is ignored: only "
                    f"{_expected(link)} counts here"
                )
            self._foreign = set(link.foreign)

    def count(self, bad: Vector) -> None:
        """Write the counts of frames that did not count."""
        link = self.link
        bad[0], bad[1] = link.damaged, link.refused
        bad[2] = sum(link.foreign.values())


def _expected(link: MavLink) -> str:
    return f"system {link.peer}" if link.peer else f"any but {link.system}"


class _Asked(NamedTuple):
    message: Any
    next_ns: int
    tries: int


class Commands:
    """Commands that are sent until the other end answers.

    Args:
        retry: Seconds between two tries.
        tries: How many there are.
    """

    def __init__(self, retry: float = 0.5, tries: int = 8) -> None:
        self._retry_ns, self._tries = round(retry * 1e9), tries
        self._asked: dict[int, _Asked] = {}

    def clear(self) -> None:
        """Forget all of them."""
        self._asked.clear()

    def ask(self, message: Any, now_ns: int) -> None:  # noqa: ANN401
        """Send a COMMAND_LONG, instead of an earlier one of the same number."""
        self._asked[message.command] = _Asked(message, now_ns, 0)

    def run(self, link: MavLink, now_ns: int) -> Iterator[str]:
        """Send what is due; yield what was refused, or not answered."""
        for answer in link.all_of("COMMAND_ACK"):
            if answer.result == IN_PROGRESS or not self._answers(link, answer):
                continue
            del self._asked[answer.command]
            if answer.result:
                yield f"command {answer.command} was refused: result {answer.result}"
        for number, asked in list(self._asked.items()):
            if now_ns < asked.next_ns:
                continue
            if asked.tries >= self._tries:
                del self._asked[number]
                yield f"command {number} was not answered"
                continue
            asked.message.confirmation = asked.tries
            link.send(asked.message)
            self._asked[number] = _Asked(
                asked.message, now_ns + self._retry_ns, asked.tries + 1
            )

    def _answers(self, link: MavLink, answer: Any) -> bool:  # noqa: ANN401
        """Return whether it is for this end, and of the component that was asked."""
        asked = self._asked.get(answer.command)
        return (
            asked is not None
            and answer.get_srcComponent() == asked.message.target_component
            and link.is_addressed(answer)
        )


IN_PROGRESS = 5
"""The result of a command that will be answered once more."""


class Every:
    """Says when something is due that happens at a rate.

    Args:
        rate: Times a second.
    """

    def __init__(self, rate: float) -> None:
        self._gap_ns = round(1e9 / rate)
        self._next_ns = 0

    def due(self, now_ns: int) -> bool:
        """Return whether it is due, once."""
        if now_ns < self._next_ns:
            return False
        late = now_ns - self._next_ns > self._gap_ns
        self._next_ns = (now_ns if late else self._next_ns) + self._gap_ns
        return True


def finite(*values: float) -> bool:
    """Return whether all values are numbers that the table takes."""
    return all(map(isfinite, values))


def setpoint_message(
    link: MavLink, component: int, setpoint: Vector, boot_ms: int
) -> Any:  # noqa: ANN401
    """Return the message of a set-point, to the other end; None if it asks nothing.

    Values that do not count by the mask are sent as 0.
    """
    kind, mask = int(setpoint[0]), int(setpoint[1])
    values = np.nan_to_num(setpoint[2:]).tolist()
    if kind == POSITION:
        return link.mav.set_position_target_local_ned_encode(
            boot_ms, link.peer, component, 1, mask, *values
        )
    if kind == ATTITUDE:
        return link.mav.set_attitude_target_encode(
            boot_ms, link.peer, component, mask, values[:4], *values[4:8]
        )
    return None


def setpoint_of(message: Any, setpoint: Vector, yaw: float) -> bool:  # noqa: ANN401
    """Write a received set-point; False: it has a frame or values that do not count.

    Args:
        message: The message.
        setpoint: Where to write it; its velocities are north, east, down.
        yaw: The vehicle's heading, in rad, for velocities in the frame of its body.
    """
    m = message
    if m.get_type() == "SET_ATTITUDE_TARGET":
        rates = m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate
        values = [*m.q, *rates, m.thrust, 0.0, 0.0, 0.0]
        kind = ATTITUDE
    else:
        if not _is_understood(m.coordinate_frame, m.type_mask):
            return False
        values = [m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz]
        values += [m.yaw, m.yaw_rate]
        kind = POSITION
    mask = m.type_mask
    counted = [0.0 if _ignored(kind, mask, k) else v for k, v in enumerate(values)]
    if kind == POSITION and m.coordinate_frame in BODY:
        _turn(counted, yaw)
    if not finite(*counted):
        return False
    setpoint[0], setpoint[1], setpoint[2:] = kind, mask, counted
    return True


def _is_understood(frame: int, mask: int) -> bool:
    """Return whether a target is local, or moves ahead or to the right of the vehicle.

    Of x and y both must count, or neither: they are turned together. Whether a yaw
    there is relative differs by autopilot, so none may count.
    """
    both = [mask >> k & 3 in {0, 3} for k in (3, 6)]
    ahead = mask & X == X and mask & YAW and all(both)
    return frame == LOCAL_NED or (frame in BODY and bool(ahead))


def _turn(values: list[float], yaw: float) -> None:
    """Turn the velocity and the acceleration of a target by a heading."""
    for k in (3, 6):
        x, y = values[k : k + 2]
        values[k] = x * cos(yaw) - y * sin(yaw)
        values[k + 1] = x * sin(yaw) + y * cos(yaw)


def _ignored(kind: int, mask: int, k: int) -> bool:
    """Return whether value k does not count by the mask."""
    if kind == POSITION:
        return bool(mask >> (k if k < 9 else k + 1) & 1)  # noqa: PLR2004 - bit 9: force
    attitude = 0x80 if k < 4 else 1 << (k - 4) if k < 7 else 0x40 if k == 7 else 0  # noqa: PLR2004
    return bool(mask & attitude)
