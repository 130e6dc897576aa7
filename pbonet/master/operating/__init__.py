"""Tools of an operator: the live table of a subsystem, and all machines of a domain."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
