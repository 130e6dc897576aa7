"""The agent: the network side of an RTPU (Stewart 1994, section 4.5)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
