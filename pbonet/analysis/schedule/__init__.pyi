from . import (
    analysis as analysis,
    chart as chart,
    criticality as criticality,
    effective_time as effective_time,
    histogram as histogram,
    transfers as transfers,
)
from .analysis import (
    Demand as Demand,
    Transformation as Transformation,
    critical_set as critical_set,
    edf_schedulable as edf_schedulable,
    largest_server as largest_server,
    level_guaranteed as level_guaranteed,
    set_aside as set_aside,
    transform as transform,
)
from .core_share import ASSUMED as ASSUMED, CoreShare as CoreShare
from .criticality import (
    INSIDE as INSIDE,
    Assigned as Assigned,
    Timing as Timing,
    dropped as dropped,
)
from .effective_time import Profile as Profile
from .events import Event as Event, turns as turns
from .histogram import BINS as BINS, edge_ns as edge_ns, octaves as octaves
from .outcome import Outcome as Outcome
from .records import (
    CoreStatus as CoreStatus,
    Decision as Decision,
    Histograms as Histograms,
    Kind as Kind,
    Mode as Mode,
    Probe as Probe,
    Section as Section,
    SlotStatus as SlotStatus,
)
from .servers import (
    Server as Server,
    ServerKind as ServerKind,
    server_size as server_size,
)
from .simulate import (
    Core as Core,
    PeriodicTask as PeriodicTask,
    ServerTask as ServerTask,
)
