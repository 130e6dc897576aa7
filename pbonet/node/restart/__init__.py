"""Restart of tasks that were lost with their RTPU process, and takeover by standbys."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
