"""Events as messages that viewers list among logs."""

from __future__ import annotations

from typing import Any, Final

LOG_SCHEMA: Final = {
    "type": "object",
    "title": "foxglove.Log",
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {
                "sec": {"type": "integer", "minimum": 0},
                "nsec": {"type": "integer", "minimum": 0, "maximum": 999999999},
            },
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
        "event": {"type": "object"},
    },
}
_LEVELS: Final = ((50, 5), (40, 4), (30, 3), (20, 2))
"""Minimum severities of events, and the log levels that viewers show for them."""


def log_message(event: dict[str, Any], time_ns: int, subsystem: str) -> dict[str, Any]:
    """Return an event as a message of `LOG_SCHEMA`.

    Args:
        event: Its fields.
        time_ns: Its time, in nanoseconds since 1970.
        subsystem: The subsystem of the event.
    """
    severity = int(event["severity"])
    sec, nsec = divmod(time_ns, 10**9)
    task = event.get("task") or event.get("rtpu", "")
    return {
        "timestamp": {"sec": sec, "nsec": nsec},
        "level": next((level for least, level in _LEVELS if severity >= least), 1),
        "message": f"{event['code']}: {event['text']}",
        "name": f"{subsystem}/{task}",
        "file": "",
        "line": 0,
        "event": event,
    }
