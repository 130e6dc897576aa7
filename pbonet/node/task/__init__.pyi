from . import fork_server as fork_server, journal as journal
from .executor import Executor as Executor
from .journal import files_of as files_of
from .module_inspector import Inspected as Inspected, inspect as inspect
from .parameters_in_task import get_params as get_params, set_param as set_param
from .step_failures import RAISED as RAISED, own_place as own_place, placed as placed
from .task_channel import INTERRUPT as INTERRUPT, RtpuChannel as RtpuChannel
from .task_output import PIPE_BYTES as PIPE_BYTES, Lines as Lines
from .task_ports import check_ports as check_ports
from .task_process import (
    Host as Host,
    record_bytes as record_bytes,
    ring_bytes as ring_bytes,
)
