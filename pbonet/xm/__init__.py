"""Express mail: how tasks, agents and masters reach each other (Stewart 1994, 5.3).

Semaphores, message queues and shared memory segments are what modules and programs
import from here. Keys, messages, sessions and the request layer stand in files of their
own, and everything over zenoh is opened there: importing this loads no network.
"""

from ._ipc import Full, Policy, Queue, Semaphore, Taken
from .carriers import alive
from .files import sweep
from .mailboxes import Mailbox, interrupt
from .names import live_on
from .open import queue, segment, semaphore
from .segments import Segment

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
