"""Cost of moving data between the table and local tables (equations 6, 7, 27).

The thesis locks its table; this table has no lock (`pbonet.svar`). Here is what becomes
of its equations without one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

RETRIES = 15
"""How often a reader that was lapped copies again (``PB_TRIES`` in svar/cut.h)."""


def rate(sizes: Iterable[float], period: float, overhead: float = 0.0) -> float:
    """Return what a module moves a second: Z of equation 6.

    Args:
        sizes: Of its in- and out-variables, bytes.
        period: Seconds.
        overhead: Of locking, in bytes: zero here, as nothing is locked.

    Returns:
        Bytes a second.

    Raises:
        ValueError: The period is not above zero.
    """
    if not period > 0:
        msg = f"period {period} s is not above zero"
        raise ValueError(msg)
    return (sum(sizes) + overhead) / period


def bandwidth(rates: Iterable[float]) -> float:
    """Return what all modules move a second: B of equation 7.

    It is compared with what the memory was measured to copy, in bytes a second.
    """
    return sum(rates)


def write_wait() -> float:
    """Return how long a task waits to write: equation 27 without a lock.

    A writer copies into a slot that no newest reader needs and publishes it by one
    store, so no other task makes it wait.
    """
    return 0.0


def read_wait(copy: float, retries: int) -> float:
    """Return how much longer a read takes at worst: equation 27 without a lock.

    A reader that was lapped by a writer copies again, at most `retries` times; then it
    uses whole groups whose common cut is not proven, and says so.

    Args:
        copy: One copy of all in-variables; any unit of time.
        retries: The bound.

    Returns:
        Time in the same unit.

    Raises:
        ValueError: An argument is below zero.
    """
    if copy < 0 or retries < 0:
        msg = f"{retries} retries of {copy} are no time"
        raise ValueError(msg)
    return copy * retries
