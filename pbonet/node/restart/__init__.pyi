from .desired_state import (
    DesiredState as DesiredState,
    StopLeft as StopLeft,
    path_of as path_of,
)
from .standby_takeover import Takeovers as Takeovers
from .task_restarts import TaskRestarts as TaskRestarts
