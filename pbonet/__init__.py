"""pbonet: assemble a robot's control software from port-based objects.

These are the names that the author of a module imports. Programs that steer a subsystem
import `pbonet.master`; tests of modules import `pbonet.testing`.
"""

from pbonet.pbo import (
    Answer,
    Handling,
    Params,
    PortBasedObject,
    Recovery,
    Signal,
    State,
    TaskContext,
    TimingFailure,
    UserSignal,
    param,
)
from pbonet.ports import InConst, InVar, Matrix, OutConst, OutVar, Vector

from .errors import PbonetError

__all__ = [
    "Answer",
    "Handling",
    "InConst",
    "InVar",
    "Matrix",
    "OutConst",
    "OutVar",
    "Params",
    "PbonetError",
    "PortBasedObject",
    "Recovery",
    "Signal",
    "State",
    "TaskContext",
    "TimingFailure",
    "UserSignal",
    "Vector",
    "param",
]

__version__ = "0.1.0"
