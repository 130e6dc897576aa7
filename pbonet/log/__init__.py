"""Logs: every cycle of a run in MCAP files, and reading them again.

::

    log = Log("runs/2026-05-04T10-11-12-teleop")
    time, torque = log.series("T_GRAV")

``writer`` and ``reader`` are the two ends of a file; ``schema`` says how cycles stand
in it, ``fields`` how names of variables become names of fields; ``scan`` finds what is
whole in a file that was cut.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
