"""Files in shared memory that table, links and express mail have in common."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
