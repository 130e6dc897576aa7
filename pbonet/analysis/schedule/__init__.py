"""The mathematics of scheduling: no clock, no process (Stewart 1994, chapter 6).

Urgency and ranks, criticalities for MUF, EDF and RM, the twin of the native dispatcher,
analysis of task sets and servers, and a simulator in virtual time.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
