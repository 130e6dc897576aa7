"""The state variable table: how tasks exchange values (Stewart 1994, section 5.5)."""

from .codes import Flags
from .local import LocalTable
from .native import survive_cuts
from .outbox import MARK
from .records import Cause, Counts, Register, VarInfo
from .table import SPARE, Table

__all__ = [
    "MARK",
    "SPARE",
    "Cause",
    "Counts",
    "Flags",
    "LocalTable",
    "Register",
    "Table",
    "VarInfo",
    "survive_cuts",
]
