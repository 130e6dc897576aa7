from . import (
    folder_watch as folder_watch,
    mailboxes as mailboxes,
    names as names,
    overview as overview,
    remote_channel as remote_channel,
    shm_object_files as shm_object_files,
)
from ._ipc import (
    Full as Full,
    Policy as Policy,
    Queue as Queue,
    Semaphore as Semaphore,
    Taken as Taken,
)
from .attach_or_create import queue as queue, segment as segment, semaphore as semaphore
from .mailboxes import Mailbox as Mailbox, interrupt as interrupt
from .names import Name as Name, live_on as live_on
from .remote_channel import alive as alive
from .segments import Segment as Segment
from .shm_object_files import FILES as FILES, sweep as sweep
