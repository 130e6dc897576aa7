"""What modules hear from outside the table: on record, and played again by a replay.

In a cycle a module reads its in-vars, which a log can rebuild. Devices, links, queues
and semaphores give it more than that. Their answers stand on a tape, which the task's
ring takes along with each cycle; a replay gives them again and opens nothing.
"""

from ._tape import Outside, Tape, active, plays, use
from .answers import NotRecordedError
from .playing import BrokenOffError, Player, refuse, using
from .told import Told

__all__ = [
    "BrokenOffError",
    "NotRecordedError",
    "Outside",
    "Player",
    "Tape",
    "Told",
    "active",
    "plays",
    "refuse",
    "use",
    "using",
]
