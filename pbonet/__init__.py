"""pbonet: assemble a robot's control software from port-based objects.

These are the names that the author of a module imports, and `Subsystem`, with which a
program assembles, steers and watches a subsystem. Each is loaded when it is first used.
Tests of modules import `pbonet.testing`.
"""

from .lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__version__ = "0.1.0"
