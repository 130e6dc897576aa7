"""Modules' inputs from outside the table: recorded, and played again by a replay.

In a cycle a module reads its in-vars, which a log can rebuild. Devices, links, queues
and semaphores provide further inputs. Their answers are recorded on a tape, which is
stored in the task's ring with each cycle; a replay returns them again and opens
nothing.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
