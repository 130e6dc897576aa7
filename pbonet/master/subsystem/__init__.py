"""Control of a subsystem: its tasks and RTPUs, and each change of them (4.4.4)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
