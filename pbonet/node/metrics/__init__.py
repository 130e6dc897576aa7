"""The figures of one RTPU in the format of Prometheus, and the server for them."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
