"""Kernels of model predictive path integral control (of `mppi_arm`)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
