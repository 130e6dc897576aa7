"""Logs: every cycle of a run in MCAP files, and reading them again.

::

    log = Log("runs/2026-05-04T10-11-12-teleop")
    time, torque = log.series("T_GRAV")

``writer`` and ``reader`` are the two ends of a file; ``schema`` says how cycles stand
in it, ``fields`` how names of variables become names of fields; ``scan`` finds what is
whole in a file that was cut.
"""

from .cycles import COLUMNS, STABLE, Cycles
from .fields import field_name, variable_name
from .part import Part
from .reader import Life, Log, Message, files_of, last_run, log_name
from .records import Attached, CodeFile, Did, RunAbout, Step, TaskAbout
from .rows import Rows
from .scan import is_complete
from .writer import LogWriter

__all__ = [
    "COLUMNS",
    "STABLE",
    "Attached",
    "CodeFile",
    "Cycles",
    "Did",
    "Life",
    "Log",
    "LogWriter",
    "Message",
    "Part",
    "Rows",
    "RunAbout",
    "Step",
    "TaskAbout",
    "field_name",
    "files_of",
    "is_complete",
    "last_run",
    "log_name",
    "variable_name",
]
