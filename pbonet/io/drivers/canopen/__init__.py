"""Nodes of CANopen: their objects by requests (SDO), and their process data (PDO)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
