"""The executive of a special purpose processor, and what keeps it running."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
