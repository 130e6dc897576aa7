"""The states of a task."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """The states of a task (Stewart 1994, Figure 3.10)."""

    NOT_CREATED = "NOT-CREATED"
    OFF = "OFF"
    ON = "ON"
    ERROR = "ERROR"
