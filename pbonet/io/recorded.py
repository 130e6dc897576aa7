"""A six-axis ball that an operator pushed once, played again.

A trace is a text file of lines ``seconds packet``, where the packet is what the ball
sent, in the ball's own protocol (`pbonet.io.magellan`); ``#`` begins a comment, and the
last line, ``seconds end``, says how long the trace is. Traces are found by name among
those that come with pbonet; no path is followed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pbonet.errors import DeviceError, did_you_mean

from .magellan import AT_REST, END, Decoder, Keys, Motion

if TYPE_CHECKING:
    from .magellan import Packet

SUFFIX = ".trace"
_FOLDER = Path(__file__).parent / "traces"


class _Entry(NamedTuple):
    time_ns: int
    packet: Packet


class RecordedBall:
    """A trace with the interface of `pbonet.io.magellan.Ball`.

    It begins with the first poll, and again with the first poll after `restart`.

    Args:
        name: The trace's name, without folder and suffix.
        repeat: Whether it repeats at its end; otherwise the ball is at rest from then
            on.

    Raises:
        DeviceError: There is no such trace, or it is damaged.
    """

    def __init__(self, name: str, *, repeat: bool = False) -> None:
        self.fault: DeviceError | None = None
        self.motion = AT_REST
        self.keys = Keys(0)
        self.version = f"trace {name}"
        self._repeat = repeat
        self._entries, self._length_ns = parse_trace(find_trace(name), name)
        self._begin_ns: int | None = None
        self._next = 0

    @property
    def seconds(self) -> float:
        """How long the trace is."""
        return self._length_ns * 1e-9

    def poll(self, now_ns: int) -> Motion:
        """Return the ball's deflection at this time of the trace.

        Args:
            now_ns: The time, in nanoseconds of any one clock.
        """
        if self._begin_ns is None:
            self._begin_ns = now_ns
        elapsed = now_ns - self._begin_ns
        if self._repeat and elapsed >= self._length_ns:
            self._begin_ns += elapsed // self._length_ns * self._length_ns
            elapsed %= self._length_ns
            self._next = 0
        while self._next < len(self._entries):
            time_ns, packet = self._entries[self._next]
            if time_ns > elapsed:
                break
            self._take(packet)
            self._next += 1
        return self.motion

    def close(self) -> None:
        """Rest, and start again at the next poll."""
        self.restart()

    def restart(self) -> None:
        """Rest, and start again at the next poll."""
        self._begin_ns = None
        self._next = 0
        self.motion = AT_REST
        self.keys = Keys(0)

    def _take(self, packet: Packet) -> None:
        if isinstance(packet, Motion):
            self.motion = packet
        elif isinstance(packet, Keys):
            self.keys = packet


def traces() -> list[str]:
    """Return the names of the traces that come with pbonet."""
    return sorted(path.name.removesuffix(SUFFIX) for path in _FOLDER.glob(f"*{SUFFIX}"))


def find_trace(name: str) -> str:
    """Return the text of the trace `name`.

    Raises:
        DeviceError: There is none.
    """
    known = traces()
    if name not in known:
        raise DeviceError(
            "there is no such operator trace",
            where=name,
            expected=" or ".join(known),
            remedy=did_you_mean(name, known) or "name one of these",
        )
    return (_FOLDER / f"{name}{SUFFIX}").read_text(encoding="ascii")


def parse_trace(text: str, name: str) -> tuple[list[_Entry], int]:
    """Return the packets of a trace with their times, and its length; nanoseconds.

    Raises:
        DeviceError: A line is not ``seconds packet``, or goes back in time.
    """
    entries: list[_Entry] = []
    length_ns = -1
    last_ns = 0
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        time_ns = _time(words, last_ns)
        ended = length_ns >= 0
        packet = None if words[1:] == ["end"] else _packet(words)
        if time_ns is None or ended or (packet is None and words[1:] != ["end"]):
            raise DeviceError(
                "the operator trace is damaged",
                where=f"{name}{SUFFIX}:{number}",
                expected="`seconds packet` in the order of time, then `seconds end`",
                got=line.strip(),
                remedy="correct the line, or record the trace again",
            )
        last_ns = time_ns
        if packet is None:
            length_ns = time_ns
        else:
            entries.append(_Entry(time_ns, packet))
    if length_ns <= 0:
        raise DeviceError(
            "the operator trace is cut short",
            where=f"{name}{SUFFIX}",
            expected="`seconds end` as its last line",
            remedy="restore it, or record it again",
        )
    return entries, length_ns


def _time(words: list[str], last_ns: int) -> int | None:
    try:
        time_ns = round(float(words[0]) * 1e9)
    except (ValueError, OverflowError):
        return None
    return time_ns if time_ns >= last_ns else None


def _packet(words: list[str]) -> Packet | None:
    if len(words) != 2:  # noqa: PLR2004 - seconds and packet
        return None
    packets = list(Decoder().feed(words[1].encode() + END))
    return packets[0] if packets else None
