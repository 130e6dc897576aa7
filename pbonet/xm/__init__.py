"""Express mail: how tasks, agents and masters reach each other (Stewart 1994, 5.3).

Semaphores, message queues and shared memory segments are what modules and programs
import from here. Keys, messages, sessions and the request layer stand in files of their
own, and everything over zenoh is opened there: importing this loads no network.
"""

from pbonet.xm.ipc._ipc import Full, Policy, Queue, Semaphore, Taken
from pbonet.xm.ipc.attach_or_create import queue, segment, semaphore
from pbonet.xm.ipc.mailboxes import Mailbox, interrupt
from pbonet.xm.ipc.names import live_on
from pbonet.xm.ipc.remote_channel import alive
from pbonet.xm.ipc.segments import Segment
from pbonet.xm.ipc.shm_object_files import sweep

__all__ = [
    "Full",
    "Mailbox",
    "Policy",
    "Queue",
    "Segment",
    "Semaphore",
    "Taken",
    "alive",
    "interrupt",
    "live_on",
    "queue",
    "segment",
    "semaphore",
    "sweep",
]
