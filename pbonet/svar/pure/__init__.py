"""The table's protocol in plain Python, a test oracle; see `arena` and `local`."""

from .arena import (
    CAUSES,
    STATIC_BYTES,
    VERSION,
    Arena,
    Blueprint,
    now_ns,
    process_start,
)
from .local import LocalTable

__all__ = [
    "CAUSES",
    "STATIC_BYTES",
    "VERSION",
    "Arena",
    "Blueprint",
    "LocalTable",
    "now_ns",
    "process_start",
]
