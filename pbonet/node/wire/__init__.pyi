from . import (
    core_trace as core_trace,
    cpu_idle_states as cpu_idle_states,
    event_log as event_log,
    lifecycle as lifecycle,
    process_setup as process_setup,
    rtpu_messages as rtpu_messages,
)
from .answer_packing import Answers as Answers, being_stopped as being_stopped
from .clock_offsets import (
    Clock as Clock,
    ClockOffsets as ClockOffsets,
    RoundTrip as RoundTrip,
    RoundTrips as RoundTrips,
    round_trip as round_trip,
)
from .command_record import command as command
from .core_times import CoreTimes as CoreTimes
from .core_wait import CoreWait as CoreWait, main_thread_times as main_thread_times
from .event_log import (
    EventLog as EventLog,
    LineBudget as LineBudget,
    by_task as by_task,
    severity as severity,
)
from .exit_codes import ORPHANED as ORPHANED, describe_end as describe_end
from .lifecycle import (
    NOT_MADE as NOT_MADE,
    RULES as RULES,
    Event as Event,
    Failure as Failure,
    Outcome as Outcome,
    Rule as Rule,
    Step as Step,
    outcome as outcome,
    rule as rule,
    signal_event as signal_event,
)
from .neighbour_orders import (
    Neighbours as Neighbours,
    ask_neighbours as ask_neighbours,
)
from .rtpu_messages import (
    Note as Note,
    Recorder as Recorder,
    Recording as Recording,
    RtpuInfo as RtpuInfo,
    TaskSpec as TaskSpec,
)
from .sanitise_values import UNTOLD as UNTOLD, readable as readable
