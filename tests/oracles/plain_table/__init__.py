"""The table's protocol in plain Python, a test oracle; see `arena` and `local`."""

from .arena import STATIC_BYTES, VERSION, Arena, Blueprint
from .flag import CAUSES, CAUSES_EACH
from .local import LocalTable
from .process import now_ns, process_start, survive_cuts

__all__ = [
    "CAUSES",
    "CAUSES_EACH",
    "STATIC_BYTES",
    "VERSION",
    "Arena",
    "Blueprint",
    "LocalTable",
    "now_ns",
    "process_start",
    "survive_cuts",
]
