"""The codes of a node's events; ``docs/protocol.md`` describes each."""

from __future__ import annotations

from typing import Final

from pbonet.errors import BY_CODE

TOLD: Final = frozenset(
    """
    CLAIM RELEASE SPAWNED SPAWN_FAILED STATE SIGNAL_FAILED ENGAGED FALLBACK ILLEGAL
    LEGAL METHOD HANDLED LOST SIGNAL WARNING SIGNALS OUTPUT TASK_DIED FORCED ENDING
    STOPPED SET FREQ TABLE_REMOVED TABLE_BEHIND TABLE_TRUNCATED TIMING_FAILURE
    CORE_STALLED CALLS_REFUSED AGENT_GONE AGENT_BACK FORK_SERVER_DIED RTPU_DIED
    DISPATCHER_ENDED DUPLICATE_NAME XM_TOO_LONG KEYS_EXPIRE KEYS_REFUSED NOT_RESTARTED
    LINK_RENEWED LINK_UP LINK_DOWN LINK_MISFIT RECORDER_DIED RING_FULL LOG_REMOVED
    LOG_FULL LOG_CONTINUED NOT_RECORDED CLEANED PROTOCOL INTERNAL
    """.split()  # noqa: SIM905 - many words
)
"""Codes of events of a node, its tasks, tables, links and logs."""
KNOWN: Final = TOLD | BY_CODE.keys()
"""All codes: `TOLD`, and the errors that are reported as events."""
