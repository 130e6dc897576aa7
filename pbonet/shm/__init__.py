"""Shared memory: the folder of its files, making and opening them, closing."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
