"""The state variable table: how tasks exchange values (Stewart 1994, section 5.5)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
