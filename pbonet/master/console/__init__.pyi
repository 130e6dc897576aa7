from . import (
    ask_master as ask_master,
    follow_events as follow_events,
    interfaces as interfaces,
    live_screen as live_screen,
    live_status as live_status,
    oneshot as oneshot,
    profile_plot as profile_plot,
    render as render,
    stop_all as stop_all,
    watch_status as watch_status,
    watch_values as watch_values,
)
from .command_session import (
    Call as Call,
    CommandSession as CommandSession,
    Reply as Reply,
    convert as convert,
    read as read,
)
from .commands import (
    COMMANDS as COMMANDS,
    Arg as Arg,
    Command as Command,
    Kind as Kind,
    Scope as Scope,
    Use as Use,
    described as described,
    find as find,
)
from .follow_events import Follower as Follower
from .interfaces import serve as serve
from .network_interface import Port as Port
from .program import Subsystem as Subsystem
from .run_agents import launch_agents as launch_agents
from .run_end import Interrupts as Interrupts
from .run_job import run as run
