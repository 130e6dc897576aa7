"""Parameters that a vehicle serves over MAVLink, and a station's view of them."""

from __future__ import annotations

import struct
from math import isfinite
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet import Vector
    from pbonet.io import MavLink

REAL32 = 9
BURST = 10
"""Parameters of a list that one cycle sends."""
LONGEST = 16
"""Characters of a parameter's name."""


class ParameterServer:
    """Serves a vector of numbers by name.

    Args:
        link: The link of the vehicle.
        names: A name for each element.
        values: What they are at first.

    Attributes:
        values: What they are; stations change them.
    """

    def __init__(
        self, link: MavLink, names: Sequence[str], values: Sequence[float]
    ) -> None:
        self._link, self._names = link, tuple(names)
        self.values: Vector = np.array(values, dtype=np.float64)
        self._next = len(names)

    def run(self) -> list[str]:
        """Answer what has arrived; return what was changed, as ``name = value``."""
        link, changed = self._link, list[str]()
        for m in link.all_of("PARAM_REQUEST_READ"):
            k = m.param_index if m.param_index >= 0 else self._find(m.param_id)
            if 0 <= k < len(self._names):
                self._send(k)
        for m in link.all_of("PARAM_SET"):
            k = self._find(m.param_id)
            if k < 0:
                continue
            if np.isfinite(m.param_value) and self.values[k] != m.param_value:
                self.values[k] = m.param_value
                changed.append(f"{self._names[k]} = {m.param_value:g}")
            self._send(k)  # what holds, which refuses another value
        if link.has("PARAM_REQUEST_LIST"):
            self._next = 0
        end = min(self._next + BURST, len(self._names))
        for k in range(self._next, end):
            self._send(k)
        self._next = end
        return changed

    def _find(self, name: str | bytes) -> int:
        wanted = name_of(name)
        return self._names.index(wanted) if wanted in self._names else -1

    def _send(self, k: int) -> None:
        message: Any = self._link.mav.param_value_encode(
            self._names[k].encode(), self.values[k], REAL32, len(self._names), k
        )
        self._link.send(message)


_FORMS: Final = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i"}
"""Types of whole numbers, as `struct` calls them."""


_RANGES: Final = {
    1: (0, 0xFF), 2: (-0x80, 0x7F), 3: (0, 0xFFFF), 4: (-0x8000, 0x7FFF),
    5: (0, 0xFFFFFFFF), 6: (-0x80000000, 0x7FFFFFFF),
}  # fmt: skip
"""The least and the most that those types hold."""
LARGEST: Final = 3.4028234663852886e38
"""The largest number that travels."""


class Told(NamedTuple):
    """A parameter as the vehicle has it."""

    value: float
    type: int
    place: int
    """Its index in the vehicle's list."""


class ParameterClient:
    """Reads and sets parameters of a vehicle, again and again until it confirms.

    Args:
        link: The link.
        component: The vehicle's component.
        retry: Seconds between two tries.
        work: Messages of one try.

    Attributes:
        known: What the vehicle has told, by name.
        wanted: What it is to have, by name.
        watched: Names that are read.
        count: How many parameters it has; 0: not known.
        bytewise: Whether whole numbers travel as the bytes of a float, as in PX4.
    """

    def __init__(
        self, link: MavLink, component: int, *, retry: float = 0.5, work: int = 16
    ) -> None:
        self._link, self._component = link, component
        self._retry_ns, self._work, self._next_ns = round(retry * 1e9), work, 0
        self.known: dict[str, Told] = {}
        self.wanted: dict[str, float] = {}
        self.watched: tuple[str, ...] = ()
        self.count = 0
        self.bytewise = False
        self._all = False

    def forget(self) -> None:
        """Read all that is wanted or watched again."""
        self.known.clear()
        self.count, self._all, self._next_ns = 0, False, 0

    def read_all(self) -> None:
        """Read every parameter that the vehicle has."""
        self.forget()
        self._all = True

    @property
    def left(self) -> int:
        """How many parameters are not as they should be, or not known."""
        open_ = {name for name in self.watched if name not in self.known}
        open_ |= {name for name in self.wanted if not self._has(name)}
        unread = self.count - self._indices() if self.count else 1
        return len(open_) + (unread if self._all else 0)

    def run(self, now_ns: int) -> list[str]:
        """Take what has come, and ask for what is missing when it is time.

        Returns:
            Why wishes were dropped.
        """
        for m in self._link.all_of("PARAM_VALUE"):
            if m.get_srcComponent() == self._component:
                self._take(m)
        if now_ns >= self._next_ns and self.left:
            self._next_ns = now_ns + self._retry_ns
            dropped = self._drop_wrong()
            self._ask()
            return dropped
        return []

    def _drop_wrong(self) -> list[str]:
        """Drop wishes that the vehicle's types cannot hold; return what to say."""
        dropped = list[str]()
        for name, value in list(self.wanted.items()):
            told = self.known.get(name)
            if told is None or told.type not in _RANGES:
                continue
            least, most = _RANGES[told.type]
            if not least <= round(value) <= most:
                del self.wanted[name]
                dropped.append(
                    f"parameter {name} is not set: {value:g} is not within the range "
                    f"of its type, {least} to {most}"
                )
        return dropped

    def _take(self, m: Any) -> None:  # noqa: ANN401
        form = _FORMS.get(m.param_type)
        value = m.param_value
        if self.bytewise and form:
            raw = struct.pack("<f", value)
            value = struct.unpack_from(f"<{form}", raw)[0]
        if not isfinite(value):
            return
        self.known[name_of(m.param_id)] = Told(value, m.param_type, m.param_index)
        self.count = m.param_count

    def _has(self, name: str) -> bool:
        told = self.known.get(name)
        if told is None:
            return False
        wanted = self.wanted[name]
        whole = told.type in _FORMS
        return told.value == (round(wanted) if whole else np.float32(wanted))

    def _indices(self) -> int:
        return len({told.place for told in self.known.values()} - {65535})

    def _ask(self) -> None:
        mav, to = self._link.mav, (self._link.peer, self._component)
        asks: list[Any] = []
        names = [*self.wanted, *self.watched]
        for name in dict.fromkeys(names):
            if name not in self.known:
                asks.append(mav.param_request_read_encode(*to, name.encode(), -1))
            elif name in self.wanted and not self._has(name):
                kind = self.known[name].type
                value = self._as_float(self.wanted[name], kind)
                asks.append(mav.param_set_encode(*to, name.encode(), value, kind))
        if self._all and not self.count:
            asks.append(mav.param_request_list_encode(*to))
        elif self._all:
            there = {told.place for told in self.known.values()}
            missing = [k for k in range(self.count) if k not in there]
            asks += [
                mav.param_request_read_encode(*to, b"", k)
                for k in missing[: self._work]
            ]
        for message in asks[: self._work]:
            self._link.send(message)

    def _as_float(self, value: float, kind: int) -> float:
        form = _FORMS.get(kind)
        if not form:
            return value
        if not self.bytewise:
            return float(round(value))
        raw = struct.pack(f"<{form}", round(value)).ljust(4, b"\0")
        return float(struct.unpack("<f", raw)[0])


def name_of(name: str | bytes) -> str:
    """Return the name of a parameter as a message has it."""
    text = name.decode("ascii", "replace") if isinstance(name, bytes) else name
    return text.rstrip("\0")
