from . import (
    claims as claims,
    cleanup as cleanup,
    orphaned_rings as orphaned_rings,
    rtpu_snapshot as rtpu_snapshot,
    status as status,
)
from .fallbacks import LIMIT as LIMIT, Pair as Pair
from .fork_client import Child as Child, Spawner as Spawner
from .request_handlers import RequestHandlers as RequestHandlers
from .rtpu_snapshot import (
    SnapshotChanges as SnapshotChanges,
    TaskSnapshot as TaskSnapshot,
)
from .rtpu_state import Rtpu as Rtpu
from .signal_tasks import obey_neighbour as obey_neighbour
from .tables import (
    Opened as Opened,
    Tables as Tables,
    lock_to_carry as lock_to_carry,
    no_table as no_table,
    remove_unused as remove_unused,
    table_name as table_name,
)
from .task_handle import Task as Task
