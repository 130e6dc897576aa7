"""The RTPU process: requests, tasks, tables and the dispatcher's thread; no network."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
