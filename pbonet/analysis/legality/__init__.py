"""Is a configuration legal, ordered, schedulable? (Stewart 1994, 3.3.1, chapter 6).

Pure functions: they take records and return records, and read no file, no clock and no
network. `judge` says what becomes of a change; the others are what it is made of, and
the orders and priorities that a master needs.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
