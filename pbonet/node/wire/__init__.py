"""What the processes of one machine have in common: messages, life cycle, events."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
