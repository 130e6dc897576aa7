"""Links between subsystems: triple buffers (Stewart 1994, section 5.6).

A link has one writer and one reader, neither waits, and the reader gets the newest
whole record. Both may be on one machine or on two; agents carry records between
machines, so a process with an end of a link needs no network code. Importing this
package loads none.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
