from .cmodule import get_include as get_include
from .errors import PbonetError as PbonetError
from .master import Subsystem as Subsystem
from .pbo import (
    Answer as Answer,
    Handling as Handling,
    Params as Params,
    PortBasedObject as PortBasedObject,
    Recovery as Recovery,
    Signal as Signal,
    State as State,
    TaskContext as TaskContext,
    TimingFailure as TimingFailure,
    UserSignal as UserSignal,
    param as param,
)
from .ports import (
    InConst as InConst,
    InVar as InVar,
    Matrix as Matrix,
    OutConst as OutConst,
    OutVar as OutVar,
    Vector as Vector,
)

__version__: str
