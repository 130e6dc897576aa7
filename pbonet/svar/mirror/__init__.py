"""A table on several machines: what each sends the others of its own part."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
