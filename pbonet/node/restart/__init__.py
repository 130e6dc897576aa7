"""The desired state of an RTPU, kept for the loss of its process or its machine."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
