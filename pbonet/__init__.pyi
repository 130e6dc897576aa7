from pbonet.master import Subsystem as Subsystem
from pbonet.pbo import (
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
from pbonet.ports import (
    InConst as InConst,
    InVar as InVar,
    Matrix as Matrix,
    OutConst as OutConst,
    OutVar as OutVar,
    Vector as Vector,
)

from .errors import PbonetError as PbonetError

__version__: str
