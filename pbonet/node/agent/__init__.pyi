from . import agent_main as agent_main, systemd_notify as systemd_notify
from .agent import Agent as Agent
from .retransmission import Retransmission as Retransmission
from .shared_memory_status import (
    HANDLED as HANDLED,
    SharedMemoryStatus as SharedMemoryStatus,
)
