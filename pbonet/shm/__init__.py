"""Shared memory: the folder of its files, how they are made and found, what closes."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
