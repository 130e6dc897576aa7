"""A table on several machines: the exchange of each machine's own part."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
