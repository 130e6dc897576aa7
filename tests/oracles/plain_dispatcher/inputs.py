"""Arguments of the inputs of the dispatcher."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection


class After(IntEnum):
    """Whose end a task that stands by waits for."""

    ALONE = 0
    """Nobody's."""
    FALLBACK = 1
    """One of them goes to ERROR, or dies while it is armed."""
    HANDOVER = 2
    """All of them are turned off in order."""


def pack(crit: int, priority: int, kind: int) -> int:
    """Return the arg of a CONFIG record."""
    return crit | priority << 8 | kind << 24


def pack_limits(
    drop: int, handler: int, *, tells: bool, safe_at: Collection[int] = ()
) -> int:
    """Return the arg of a LIMITS record."""
    kinds = sum(2 << kind for kind in safe_at)
    return drop | handler << 8 | (tells | kinds) << 16
