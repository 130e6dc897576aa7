"""The files, tasks, conditions and saved profiles that a master works with."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
