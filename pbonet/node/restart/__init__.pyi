from .desired_state import (
    DesiredState as DesiredState,
    StopLeft as StopLeft,
    path_of as path_of,
)
from .task_restarts import TaskRestarts as TaskRestarts
