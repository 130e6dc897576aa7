"""Port-based objects: what a module is, apart from any process (Stewart 1994, 3.3-3.6).

A module is a class that derives from `PortBasedObject`. This package reads its
declarations, decodes its parameters, binds an instance to arrays, and describes it.
"""

from ._bind import Memory, bind, check_sizes, memory
from ._combine import Fault, Part, faults
from ._combined import Combined, PartClass, combine
from ._describe import (
    ModuleInfo,
    ParamInfo,
    PartInfo,
    combined_info,
    describe,
    local_text,
    render,
    source_version,
)
from ._handling import (
    ErrorScope,
    Handling,
    Jump,
    innermost,
    line_of,
    number_of,
    place_of,
    said,
    text_of,
)
from ._object import METHODS, Interface, PortBasedObject, interface
from ._param import Param, param
from ._params import (
    Params,
    change_param,
    decode_params,
    find_param,
    make_params,
    params_type,
)
from ._schedule import Counted, Schedule
from ._signals import (
    PREDEFINED,
    SIGNALS,
    Signal,
    SignalInfo,
    UserSignal,
    signal_bits,
    signal_names,
)
from ._task import (
    Answer,
    BoundedOutbox,
    Notice,
    Outbox,
    State,
    TaskContext,
    TaskFailure,
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
    "PREDEFINED",
    "SIGNALS",
    "Answer",
    "BoundedOutbox",
    "Combined",
    "Counted",
    "CycleAborted",
    "ErrorScope",
    "Fault",
    "Handling",
    "Interface",
    "Jump",
    "Memory",
    "ModuleInfo",
    "Notice",
    "Outbox",
    "Param",
    "ParamInfo",
    "Params",
    "Part",
    "PartClass",
    "PartInfo",
    "PortBasedObject",
    "PythonWatch",
    "Recovery",
    "Schedule",
    "Section",
    "Signal",
    "SignalInfo",
    "State",
    "TaskContext",
    "TaskFailure",
    "TimingFailure",
    "UserSignal",
    "Watch",
    "bind",
    "change_param",
    "check_criticality",
    "check_deadline",
    "check_section",
    "check_sizes",
    "combine",
    "combined_info",
    "decode_params",
    "describe",
    "faults",
    "find_param",
    "innermost",
    "interface",
    "line_of",
    "local_text",
    "make_params",
    "memory",
    "number_of",
    "param",
    "params_type",
    "place_of",
    "render",
    "said",
    "signal_bits",
    "signal_names",
    "source_version",
    "text_of",
]
