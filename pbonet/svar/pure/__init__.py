"""The table's protocol in plain Python, a test oracle; see `arena` and `local`."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
