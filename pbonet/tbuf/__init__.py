"""Links between subsystems: triple buffers (Stewart 1994, section 5.6).

One writes, one reads, neither waits, and what is read is the newest whole record. The
two may be on one machine or on two; agents carry records from machine to machine, and
no process that has an end of a link has anything of the network. Importing this loads
no network either.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
