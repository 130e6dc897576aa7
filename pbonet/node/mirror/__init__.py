"""The agent's part in a table on several machines: sending and receiving changes."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
