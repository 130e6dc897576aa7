"""Modules in C: their header, and how a shared object becomes a module's class.

`pbonet.h` is what a module includes. The runtime calls its methods by pointer; ports,
parameters and everything else are those of an ordinary `PortBasedObject`.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
