"""Port-based objects: what a module is, apart from any process (Stewart 1994, 3.3-3.6).

A module is a class that derives from `PortBasedObject`. This package reads its
declarations, decodes its parameters, binds an instance to arrays, and describes it.
"""

from ._bind import Memory, bind, check_sizes, memory
from ._describe import (
    ModuleInfo,
    ParamInfo,
    describe,
    local_text,
    render,
    source_version,
)
from ._object import METHODS, Interface, PortBasedObject, interface
from ._params import (
    Param,
    Params,
    change_param,
    decode_params,
    find_param,
    make_params,
    param,
    params_type,
)
from ._task import (
    Answer,
    BoundedOutbox,
    Counted,
    Notice,
    Outbox,
    Schedule,
    Signal,
    State,
    TaskContext,
    TaskFailure,
    user_signal,
)
from ._timing import (
    CycleAborted,
    PythonWatch,
    Recovery,
    Section,
    TimingFailure,
    Watch,
    check_criticality,
    check_deadline,
    check_section,
)

__all__ = [
    "METHODS",
    "Answer",
    "BoundedOutbox",
    "Counted",
    "CycleAborted",
    "Interface",
    "Memory",
    "ModuleInfo",
    "Notice",
    "Outbox",
    "Param",
    "ParamInfo",
    "Params",
    "PortBasedObject",
    "PythonWatch",
    "Recovery",
    "Schedule",
    "Section",
    "Signal",
    "State",
    "TaskContext",
    "TaskFailure",
    "TimingFailure",
    "Watch",
    "bind",
    "change_param",
    "check_criticality",
    "check_deadline",
    "check_section",
    "check_sizes",
    "decode_params",
    "describe",
    "find_param",
    "interface",
    "local_text",
    "make_params",
    "memory",
    "param",
    "params_type",
    "render",
    "source_version",
    "user_signal",
]
