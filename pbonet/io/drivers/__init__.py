"""I/O devices by logical names: one interface for all (Stewart 1994, section 7.2)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
