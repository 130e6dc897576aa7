"""Is a configuration legal, ordered, schedulable? (Stewart 1994, 3.3.1, chapter 6).

Pure functions: they take records and return records, and read no file, no clock and no
network. `judge` says what becomes of a change; the others are what it is made of, and
the orders and priorities that a master needs.
"""

from __future__ import annotations

from .conditions import Outcome, check_conditions, evaluate, named
from .demands import Figure, Source, effective, least, worst
from .judge import (
    ENDING,
    Change,
    Verdict,
    as_error,
    as_text,
    check,
    frequency,
    job,
    judge,
    reconfig,
    signal,
    spawn,
)
from .order import (
    change_order,
    flow_order,
    off_order,
    on_order,
    spawn_order,
    user_priorities,
)
from .records import Code, Configuration, Problem, Severity, Task
from .reports import (
    Outlook,
    RtpuReport,
    ServerReport,
    TaskReport,
    report,
    report_data,
    report_head,
    report_text,
)
from .sharing import Sharing, sharing
from .timing import Load, criticalities, loads, traffic
from .units import conversion, same_unit
from .virtual import Code as ModuleCode
from .virtual import JobOutcome, Times, simulate_job
from .wiring import producers

__all__ = [
    "ENDING",
    "Change",
    "Code",
    "Configuration",
    "Figure",
    "JobOutcome",
    "Load",
    "ModuleCode",
    "Outcome",
    "Outlook",
    "Problem",
    "RtpuReport",
    "ServerReport",
    "Severity",
    "Sharing",
    "Source",
    "Task",
    "TaskReport",
    "Times",
    "Verdict",
    "as_error",
    "as_text",
    "change_order",
    "check",
    "check_conditions",
    "conversion",
    "criticalities",
    "effective",
    "evaluate",
    "flow_order",
    "frequency",
    "job",
    "judge",
    "least",
    "loads",
    "named",
    "off_order",
    "on_order",
    "producers",
    "reconfig",
    "report",
    "report_data",
    "report_head",
    "report_text",
    "same_unit",
    "sharing",
    "signal",
    "simulate_job",
    "spawn",
    "spawn_order",
    "traffic",
    "user_priorities",
    "worst",
]
