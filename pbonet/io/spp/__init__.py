"""Special purpose processors: buffered calls to a library of kernels (section 7.4)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
