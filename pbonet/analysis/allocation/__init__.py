"""The assignment of tasks to RTPUs: the best one under the schedulability test.

No clock, no file, no network; `scipy` (``pip install 'pbonet[plan]'``) solves it.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
