from . import recorder_process as recorder_process
from .log_rotation import LogFiles as LogFiles, Time as Time
from .recorder_process import Recorder as Recorder
