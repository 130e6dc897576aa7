"""The codes of a node's events, and texts that others read from them.

``docs/protocol.md`` describes each code.
"""

from __future__ import annotations

from typing import Final

from pbonet.errors import BY_CODE

TOLD: Final = frozenset(
    """
    CLAIM RELEASE TAKEN_OVER
    SPAWNED SPAWN_FAILED STATE SIGNAL_FAILED ENGAGED FALLBACK ILLEGAL
    LEGAL METHOD HANDLED LOST SIGNAL WARNING SIGNALS OUTPUT TASK_DIED FORCED ENDING
    STOPPED STEP SET FREQ TABLE_REMOVED TABLE_BEHIND TABLE_DAMAGED TIMING_FAILURE HANGS
    LEFT_SAFE WAITS SCHEDULING_CHANGED STALE FRESH
    CORE_STALLED CALLS_REFUSED AGENT_GONE AGENT_BACK RESUMED FORK_SERVER_DIED
    RTPU_DIED RESTARTED NOT_SPAWNED STATE_UNREADABLE STATE_NOT_KEPT
    DISPATCHER_ENDED DUPLICATE_NAME XM_TOO_LONG KEYS_EXPIRE KEYS_REFUSED NOT_RESTARTED
    NOT_DELIVERED
    LINK_RENEWED LINK_UP LINK_DOWN LINK_MISFIT RECORDER_DIED RING_FULL LOG_REMOVED
    SPP_READY SPP_DIED SPP_OUTPUT
    LOG_FULL LOG_CONTINUED NOT_RECORDED CLEANED PROTOCOL INTERNAL
    """.split()  # noqa: SIM905 - many words
)
"""Codes of events of a node, its tasks, tables, links and logs."""
KNOWN: Final = TOLD | BY_CODE.keys()
"""All codes: `TOLD`, and the errors that are reported as events."""

TURNED_OFF: Final = "turned off"
KILLED: Final = "killed"
CLEARED: Final = "cleared, so it is OFF"
_DONE: Final = {
    ("on", "ON"): "turned on",
    ("off", "OFF"): TURNED_OFF,
    ("kill", "NOT-CREATED"): KILLED,
    ("clear", "OFF"): CLEARED,
}


def signal_text(signal: str, state: str, failed: str = "") -> str:
    """Return what a signal has done to a task, as the event about it says.

    Args:
        signal: The signal.
        state: The state of the task afterwards.
        failed: Why a method failed; empty: none did.
    """
    if failed:
        return f"'{signal}' failed, and it is {state}: {failed}"
    after = f"after '{signal}' it is {state}"
    return _DONE.get((signal, state), after)


def failure_text(failed: str, state: str) -> str:
    """Return what has failed in a cycle, as the event about it says.

    Args:
        failed: What has failed.
        state: The state of the task afterwards.
    """
    return f"{failed}; it is {state}"
