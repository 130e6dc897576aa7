"""Modules' inputs from outside the table: recorded, and played again by a replay.

In a cycle a module reads its in-vars, which a log can rebuild. Devices, links, queues
and semaphores give it more than that. Their answers stand on a tape, which the task's
ring takes along with each cycle; a replay gives them again and opens nothing.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
