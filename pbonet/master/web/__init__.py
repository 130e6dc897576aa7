"""The web page: what it shows of a subsystem, and the commands that it gives."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
