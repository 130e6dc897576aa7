"""The state variable table: how tasks exchange values (Stewart 1994, section 5.5)."""

from .local import LocalTable
from .native import survive_cuts
from .result_codes import Flags
from .table import SPARE, Table
from .table_records import Cause, Counts, Register, VarInfo

__all__ = [
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
