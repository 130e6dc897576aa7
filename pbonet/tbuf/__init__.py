"""Links between subsystems: triple buffers (Stewart 1994, section 5.6).

One writes, one reads, neither waits, and what is read is the newest whole record. The
two may be on one machine or on two; agents carry records from machine to machine, and
no process that has an end of a link has anything of the network. Importing this loads
no network either.
"""

from .ends import Reader, Writer
from .places import sweep
from .seen import seen

__all__ = ["Reader", "Writer", "seen", "sweep"]
