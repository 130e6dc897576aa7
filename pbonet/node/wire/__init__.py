"""Shared by the processes of one machine: messages, life cycle, events."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
