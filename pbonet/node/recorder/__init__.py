"""The recorder process: writes the records in tasks' rings to MCAP files."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
