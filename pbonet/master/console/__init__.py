"""The commands, and the interfaces that give them: prompt, verbs, network (4.4)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
