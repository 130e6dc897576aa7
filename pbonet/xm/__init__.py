"""Express mail: how tasks, agents and masters reach each other (Stewart 1994, 5.3).

Semaphores, message queues and shared memory segments are what modules and programs
import from here. Keys, messages, sessions and the request layer stand in files of their
own, and everything over zenoh is opened there: importing this loads no network.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
