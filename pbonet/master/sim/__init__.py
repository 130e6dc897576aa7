"""A subsystem in virtual time: RTPUs without processes, network or devices."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
