"""The ring of records between a task and the recorder: native, neither ever waits."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
