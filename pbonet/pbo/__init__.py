"""Port-based objects: what a module is, apart from any process (Stewart 1994, 3.3-3.6).

A module is a class that derives from `PortBasedObject`. This package reads its
declarations, decodes its parameters, binds an instance to arrays, and describes it.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
