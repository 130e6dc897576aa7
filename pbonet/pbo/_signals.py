"""Signals from a task to its master (Stewart 1994, section 4.4.4)."""

from __future__ import annotations

import re
from enum import IntFlag
from typing import TYPE_CHECKING, Self

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


class Signal(IntFlag):
    """Signals from a task to its master (Stewart 1994, section 4.4.4), 32 at most."""

    OFF = 1 << 0
    """The goal is reached; the task turns itself off after this cycle."""
    FINISH = 1 << 1
    """The goal is reached; the task continues its cycles."""
    ERROR = 1 << 2
    """The task has entered the ERROR state, or died; sent by the runtime."""
    WARNING = 1 << 3
    """The task has warned; sent by the runtime."""
    SHUTDOWN = 1 << 4
    """A fatal error; the task has begun to shut the system down gracefully."""
    ILLEGAL = 1 << 5
    """The task has raised the illegal-configuration flag."""
    LEGAL = 1 << 6
    """The task has withdrawn its entry from the illegal-configuration flag."""


SIGNALS = 32
"""How many signals there are, the predefined ones included."""
PREDEFINED = {one.name or "": int(one) for one in Signal}
"""Names and bits of the signals that every task has."""
_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,30}")


class UserSignal(int):
    """A user-defined signal, declared in the module's class body.

    ``GRASPED = UserSignal(0, "the gripper holds an object")`` is sent with
    ``self.task.signal(self.GRASPED)`` and waited for by its name. As a number it is the
    signal's bit.

    Args:
        number: 0 to 24, unique in the module; it identifies the signal in messages.
        doc: A description for the user of the module.

    Raises:
        ValueError: The number is not valid.
    """

    number: int
    doc: str

    def __new__(cls, number: int, doc: str) -> Self:
        if not 0 <= number < SIGNALS - len(Signal):
            last = SIGNALS - len(Signal) - 1
            message = f"user signals go from 0 to {last}, not {number}"
            raise ValueError(message)
        made = super().__new__(cls, 1 << (len(Signal) + number))
        made.number = number
        made.doc = doc
        return made


class SignalInfo(Struct, frozen=True):
    """A module's own signal, as its class body declares it."""

    name: str
    number: int
    doc: str

    @property
    def bit(self) -> int:
        """The signal as a bit of `Signal`."""
        return 1 << (len(Signal) + self.number)


def refusal(name: str) -> str:
    """Return why a signal cannot have this name; empty when it can."""
    if name in PREDEFINED:
        return f"every task has a signal {name} already"
    if not _NAME.fullmatch(name):
        return "a signal's name has 1 to 31 capital letters, digits and _"
    return ""


def signal_names(bits: int, own: Mapping[str, int]) -> list[str]:
    """Return the names of the signals in `bits`, the lowest bit first.

    Args:
        bits: Of `Signal`.
        own: Names and bits of the module's own signals; one without is ``user N``.
    """
    known = {bit: name for name, bit in (PREDEFINED | dict(own)).items()}
    return [
        known.get(1 << k, f"user {k - len(Signal)}")
        for k in range(SIGNALS)
        if bits >> k & 1
    ]


def signal_bits(names: Iterable[str], own: Mapping[str, int]) -> int:
    """Return the signals of these names that a module has, as bits of `Signal`."""
    known = PREDEFINED | dict(own)
    found = 0
    for name in names:
        found |= known.get(name, 0)
    return found
