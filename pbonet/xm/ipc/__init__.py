"""Semaphores, queues, segments, mailboxes, files by name (Stewart 1994, 5.3-5.4)."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
