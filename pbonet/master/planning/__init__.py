"""Plans for a job: which RTPU runs which task, and how often each task runs."""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
