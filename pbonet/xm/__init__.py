"""Express mail: how tasks, agents and masters reach each other (Stewart 1994, 5.3).

Modules and programs import semaphores, message queues and shared memory segments from
here. Keys, messages, sessions and the request layer are in `pbonet.xm.net`, which alone
uses zenoh: importing this package loads no network code.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
