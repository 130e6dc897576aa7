"""Machines with agents: set up over ssh, upgraded one by one, backed up, restored."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
