from . import profiling as profiling, status_fields as status_fields
from .argument_text import (
    collected as collected,
    is_sequence as is_sequence,
    sequence as sequence,
)
from .embedded_agents import Embedded as Embedded
from .event_filter import EventFilter as EventFilter, since as since
from .missing_tasks import Missing as Missing, find_missing as find_missing
from .recording_control import RecordingControl as RecordingControl
from .refusals_of_start import start_refusals as start_refusals
from .rtpu_clients import client_name as client_name, core_shares as core_shares
from .sequencer import (
    STOPPED_ELSEWHERE as STOPPED_ELSEWHERE,
    Phase as Phase,
    Sequencer as Sequencer,
    SequenceState as SequenceState,
)
from .status_fields import (
    Window as Window,
    delay_quantile as delay_quantile,
    profile as profile,
)
from .subsystem import Subsystem as Subsystem
from .subsystem_tasks import SIGNALS as SIGNALS
from .switching import Transition as Transition
