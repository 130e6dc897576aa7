"""The process of one task, and the fork server that creates it."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
