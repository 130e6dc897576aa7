from . import sim_log as sim_log
from .sim_log import SimLog as SimLog
from .simulation import BEGIN_NS as BEGIN_NS
from .simulation import REASON as REASON
from .simulation import Simulation as Simulation
from .virtual_rtpus import VirtualClient as VirtualClient
from .virtual_rtpus import VirtualClock as VirtualClock
from .virtual_rtpus import VirtualRtpus as VirtualRtpus
