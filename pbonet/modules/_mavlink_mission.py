"""Missions over MAVLink: their items, files, and the handshakes of both ends.

Each end asks for what it has not got, again and again: so lost, repeated and exchanged
messages change nothing.
"""

from __future__ import annotations

import struct
from math import isfinite
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pbonet.errors import ParameterError

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.io import MavLink

MOST = 500
"""Items of one mission."""
ACCEPTED, FAILED, BAD_FRAME, TOO_MANY, INVALID, OUT_OF_ORDER = 0, 1, 2, 4, 5, 13
"""Results of a mission's handshake."""
RETRY_NS: Final = 400_000_000
TRIES: Final = 30
_FIRST_LINE = "QGC WPL 110"
_COLUMNS = 12
_GLOBAL = {0, 3, 5, 6, 10, 11}
"""Frames whose x and y are degrees."""
WAYPOINT, TAKEOFF = 16, 22
"""Commands of items that have a place."""
NED, ENU = 1, 4
"""Frames that are flown here, with `AMSL` and `RELATIVE`; not bodies and terrain."""
AMSL, RELATIVE = {0, 5}, {3, 6}


class Item(NamedTuple):
    """One item of a mission, as MISSION_ITEM_INT has it."""

    frame: int
    command: int
    current: int
    autocontinue: int
    p1: float
    p2: float
    p3: float
    p4: float
    x: int
    y: int
    z: float


def item_of(m: Any) -> Item:  # noqa: ANN401 - a message
    """Return the item of a message."""
    return Item(
        *(m.frame, m.command, m.current, m.autocontinue),
        *(m.param1, m.param2, m.param3, m.param4, m.x, m.y, m.z),
    )


def judge_item(one: Item) -> int:
    """Return whether an item can be flown, as `ACCEPTED`.

    Only values that are used count: stations send NaN for others.
    """
    if one.command not in {WAYPOINT, TAKEOFF}:
        return ACCEPTED
    if one.frame not in {NED, ENU, *AMSL, *RELATIVE}:
        return BAD_FRAME
    hold = one.p1 if one.command == WAYPOINT else 0.0
    on_earth = abs(one.x) <= 90e7 and abs(one.y) <= 180e7  # noqa: PLR2004
    if not isfinite(one.z) or not isfinite(hold):
        return INVALID
    return ACCEPTED if one.frame in {NED, ENU} or on_earth else INVALID


def read_mission(text: str, where: str) -> list[Item]:
    """Return the items of a file as ground stations write it (QGC WPL 110).

    Raises:
        ParameterError: A line is not one of an item.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines or lines[0].strip() != _FIRST_LINE:
        raise _bad(where, lines[0] if lines else "nothing", f"{_FIRST_LINE} first")
    items: list[Item] = []
    for line in lines[1:]:
        words = line.split()
        try:
            _, current, frame, command = (int(word) for word in words[:4])
            p1, p2, p3, p4, *place, z = (float(word) for word in words[4:11])
            last = int(words[11])
        except (ValueError, IndexError):
            raise _bad(where, line, f"{_COLUMNS} numbers") from None
        scale = 1e7 if frame in _GLOBAL else 1e4
        x, y = (round(one * scale) for one in place)
        items.append(Item(frame, command, current, last, p1, p2, p3, p4, x, y, z))
    if not 0 < len(items) <= MOST:
        raise _bad(where, f"{len(items)} items", f"1 to {MOST} items")
    return items


def _bad(where: str, got: str, expected: str) -> ParameterError:
    return ParameterError(
        "this is no mission",
        where=where,
        expected=expected,
        got=got,
        remedy="save it again as a text file of waypoints",
    )


class _Transfer:
    """One side of a handshake: what is sent again until something comes.

    Args:
        link: The link.
        to: System and component of the other end.
    """

    def __init__(self, link: MavLink, to: tuple[int, int]) -> None:
        self._link, self._to = link, to
        self._again: Any = None
        self._next_ns = self._left = 0

    def _repeat(self, message: Any, now_ns: int) -> None:  # noqa: ANN401
        self._again, self._left = message, TRIES
        self._next_ns = now_ns

    def _from_there(self, m: Any) -> bool:  # noqa: ANN401
        """Return whether a message is of the other end, and for this one."""
        sender = m.get_srcSystem(), m.get_srcComponent()
        return sender == self._to and self._link.is_addressed(m)

    def _send_again(self, now_ns: int) -> bool:
        """Send what is due; False: the other end does not answer any more."""
        if self._again is None or now_ns < self._next_ns:
            return True
        if self._left == 0:
            self._again = None
            return False
        self._left -= 1
        self._next_ns = now_ns + RETRY_NS
        self._link.send(self._again)
        return True


class Download(_Transfer):
    """Fetches a mission, item by item.

    Args:
        link: The link.
        to: System and component of the other end.
        count: How many items there are, if that is known: then it is asked for them
            at once, and receives an acknowledgement when all have come.
        judge: Called with each item; other than `ACCEPTED` ends the download with it.
    """

    def __init__(
        self,
        link: MavLink,
        to: tuple[int, int],
        now_ns: int,
        count: int = -1,
        judge: Callable[[Item], int] = lambda _: ACCEPTED,
    ) -> None:
        super().__init__(link, to)
        self._count, self._judge = count, judge
        self.items: list[Item] = []
        self.result = -1
        """-1 while it goes on; else as `ACCEPTED`."""
        mav = link.mav
        if count < 0:
            self._repeat(mav.mission_request_list_encode(*to), now_ns)
        else:
            self._next_item(now_ns)

    def run(self, now_ns: int) -> None:
        """Take what has come."""
        if self.result >= 0:
            return
        for m in self._link.all_of("MISSION_COUNT"):
            if self._count < 0 and self._from_there(m):
                self._count = m.count
                self._next_item(now_ns)
        for m in self._link.all_of("MISSION_ITEM_INT"):
            if m.seq == len(self.items) < self._count and self._from_there(m):
                self._take(item_of(m), now_ns)
        if self.result < 0 and not self._send_again(now_ns):
            self.result = FAILED

    def _take(self, item: Item, now_ns: int) -> None:
        refused = self._judge(item)
        if refused:
            self.result = refused
            self._link.send(self._link.mav.mission_ack_encode(*self._to, refused))
            return
        self.items.append(item)
        self._next_item(now_ns)

    def _next_item(self, now_ns: int) -> None:
        mav, seq = self._link.mav, len(self.items)
        if seq < self._count:
            self._repeat(mav.mission_request_int_encode(*self._to, seq), now_ns)
            return
        self.result = ACCEPTED
        self._link.send(mav.mission_ack_encode(*self._to, ACCEPTED))


class Upload(_Transfer):
    """Gives a mission to a vehicle, which asks for the items.

    Args:
        link: The link.
        to: System and component of the vehicle.
        items: The mission.
    """

    def __init__(
        self, link: MavLink, to: tuple[int, int], items: list[Item], now_ns: int
    ) -> None:
        super().__init__(link, to)
        self._items = items
        self._last_asked = False
        self.result = -1
        self._repeat(link.mav.mission_count_encode(*to, len(items)), now_ns)

    def run(self, now_ns: int) -> None:
        """Answer what has come."""
        for kind in ("MISSION_REQUEST_INT", "MISSION_REQUEST"):
            for m in self._all_from_there(kind):
                if self.result < 0 and m.seq < len(self._items):
                    seq = int(m.seq)
                    item = item_message(self._link, self._to, seq, self._items[seq])
                    self._repeat(item, now_ns)
                    self._last_asked |= m.seq == len(self._items) - 1
        for m in self._all_from_there("MISSION_ACK"):
            ended = self._last_asked or m.type  # or it answers an earlier one
            if self.result < 0 and m.mission_type == 0 and ended:
                self.result = m.type
        if self.result < 0 and not self._send_again(now_ns):
            self.result = FAILED

    def _all_from_there(self, kind: str) -> list[Any]:
        return [m for m in self._link.all_of(kind) if self._from_there(m)]


def item_message(link: MavLink, to: tuple[int, int], seq: int, one: Item) -> Any:  # noqa: ANN401
    """Return the message of an item."""
    return link.mav.mission_item_int_encode(*to, seq, *one)


class MissionServer:
    """Keeps the mission of a vehicle: stations write and read it.

    Args:
        link: The link.
        say: Called with what stations should read.

    Attributes:
        items: The mission.
        current: The item that is flown.
    """

    def __init__(self, link: MavLink, say: Callable[[str], None]) -> None:
        self._link, self._say = link, say
        self.items: list[Item] = []
        self.current = 0
        self._upload: Download | None = None

    def run(self, now_ns: int, ours: Callable[[Any], bool]) -> None:
        """Answer what has come for this vehicle."""
        self._take_upload(now_ns, ours)
        link, mav = self._link, self._link.mav
        for m in self._asked("MISSION_REQUEST_LIST", ours):
            to = m.get_srcSystem(), m.get_srcComponent()
            link.send(mav.mission_count_encode(*to, len(self.items)))
        for kind in ("MISSION_REQUEST_INT", "MISSION_REQUEST"):
            for m in self._asked(kind, ours):
                to = m.get_srcSystem(), m.get_srcComponent()
                seq = int(m.seq)
                if seq < len(self.items):
                    link.send(item_message(link, to, seq, self.items[seq]))
                else:
                    link.send(mav.mission_ack_encode(*to, OUT_OF_ORDER))
        for m in self._asked("MISSION_CLEAR_ALL", ours):
            self.items, self.current = [], 0
            to = m.get_srcSystem(), m.get_srcComponent()
            link.send(mav.mission_ack_encode(*to, ACCEPTED))
        for m in self._asked("MISSION_SET_CURRENT", ours):
            if m.seq < len(self.items):
                self.current = m.seq
            link.send(mav.mission_current_encode(self.current))

    def _take_upload(self, now_ns: int, ours: Callable[[Any], bool]) -> None:
        for m in self._asked("MISSION_COUNT", ours):
            to = m.get_srcSystem(), m.get_srcComponent()
            if m.count > MOST:
                self._link.send(self._link.mav.mission_ack_encode(*to, TOO_MANY))
            elif self._upload is None or self._upload.items:
                # one that is repeated because the first request was lost is none more
                self._upload = Download(self._link, to, now_ns, m.count, judge_item)
        if self._upload is None:
            return
        self._upload.run(now_ns)
        if self._upload.result == ACCEPTED:
            self.items, self.current = self._upload.items, 0
            self._say(f"a mission of {len(self.items)} items")
        elif self._upload.result > 0:
            self._say(
                f"no mission: item {len(self._upload.items)} has result "
                f"{self._upload.result}"
            )
        if self._upload.result >= 0:
            self._upload = None

    def _asked(self, kind: str, ours: Callable[[Any], bool]) -> list[Any]:
        found = self._link.all_of(kind)
        return [m for m in found if ours(m) and getattr(m, "mission_type", 0) == 0]


def exact(one: Item) -> bytes:
    """Return the bits of an item, as they travel."""
    return _BITS.pack(*one)


_BITS: Final = struct.Struct("<4i4f2if")
