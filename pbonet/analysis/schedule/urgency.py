"""Urgency: one number per ready task.

The urgency value is criticality, deadline and user priority side by side, as in Figure
6.2 of Stewart 1994; equal values are served first come, first served. The levels by
which the kernel obeys it are made natively: `pbonet/node/rt/muf.h`.
"""

from __future__ import annotations

NEVER = (1 << 63) - 1
"""The deadline of a task that has none: a dynamic priority of zero."""
PRIORITY_BITS = 16
DEADLINE_BITS = 63
CRIT_MAX = 63
PRIORITY_MAX = (1 << PRIORITY_BITS) - 1


def urgency(crit: int, deadline_ns: int, priority: int) -> int:
    """Return the urgency value; the greater one runs first (section 6.2.3).

    Args:
        crit: Criticality, 0 to 63.
        deadline_ns: Absolute, CLOCK_MONOTONIC; `NEVER` for none. The thesis counts
            milliseconds from now in 20 bits; absolute nanoseconds order the same way
            and need no renewal as time goes by.
        priority: User priority, 0 to 65535.

    Raises:
        ValueError: A value is out of its range.
    """
    if not 0 <= crit <= CRIT_MAX:
        msg = f"criticality {crit} is not within 0 to {CRIT_MAX}"
        raise ValueError(msg)
    if not 0 <= deadline_ns <= NEVER:
        msg = f"deadline {deadline_ns} ns is not within 0 to {NEVER}"
        raise ValueError(msg)
    if not 0 <= priority <= PRIORITY_MAX:
        msg = f"user priority {priority} is not within 0 to {PRIORITY_MAX}"
        raise ValueError(msg)
    dynamic = NEVER - deadline_ns
    return (crit << DEADLINE_BITS | dynamic) << PRIORITY_BITS | priority
