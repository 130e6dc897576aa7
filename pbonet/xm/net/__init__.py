"""The network: zenoh sessions, requests, keys, certificates, the run folder."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
