from . import sim_log as sim_log
from .virtual_loop import BEGIN_NS as BEGIN_NS
from .virtual_rtpus import (
    REASON as REASON,
    VirtualRtpus as VirtualRtpus,
)
