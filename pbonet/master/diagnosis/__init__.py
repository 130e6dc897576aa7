"""The causes of a state: from facts to a chain of causes with what to do."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
