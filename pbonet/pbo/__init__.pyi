from ._bind import (
    Memory as Memory,
    bind as bind,
    check_sizes as check_sizes,
    memory as memory,
    write_safe as write_safe,
)
from ._combine import Fault as Fault, Part as Part, faults as faults
from ._combined import Combined as Combined, PartClass as PartClass, combine as combine
from ._describe import OUTPUT_DEVICES as OUTPUT_DEVICES, describe as describe
from ._handling import (
    ErrorScope as ErrorScope,
    Handling as Handling,
    Jump as Jump,
    innermost as innermost,
    line_of as line_of,
    number_of as number_of,
    place_of as place_of,
    said as said,
    text_of as text_of,
)
from ._method_names import (
    METHODS as METHODS,
    MODULE_CLASSES as MODULE_CLASSES,
    ModuleClass as ModuleClass,
)
from ._module_info import (
    ModuleInfo as ModuleInfo,
    ParamInfo as ParamInfo,
    PartInfo as PartInfo,
    combined_info as combined_info,
    local_text as local_text,
    render as render,
    source_version as source_version,
)
from ._object import (
    Interface as Interface,
    PortBasedObject as PortBasedObject,
    interface as interface,
)
from ._param import ANY_COUNT as ANY_COUNT, Param as Param, param as param
from ._params import (
    Line as Line,
    Params as Params,
    change_param as change_param,
    decode_params as decode_params,
    find_param as find_param,
    make_params as make_params,
    params_type as params_type,
)
from ._schedule import Counted as Counted, Schedule as Schedule
from ._signals import (
    PREDEFINED as PREDEFINED,
    SIGNALS as SIGNALS,
    Signal as Signal,
    SignalInfo as SignalInfo,
    UserSignal as UserSignal,
    signal_bits as signal_bits,
    signal_names as signal_names,
)
from ._state import State as State
from ._task import (
    Answer as Answer,
    BoundedOutbox as BoundedOutbox,
    Notice as Notice,
    Outbox as Outbox,
    TaskContext as TaskContext,
    TaskFailure as TaskFailure,
)
from ._timing import (
    CycleAborted as CycleAborted,
    PythonWatch as PythonWatch,
    Recovery as Recovery,
    Section as Section,
    TimingFailure as TimingFailure,
    Watch as Watch,
    check_criticality as check_criticality,
    check_deadline as check_deadline,
    check_section as check_section,
)
