"""Logs: every cycle of a run in MCAP files, and reading them again.

::

    log = Log("runs/2026-05-04T10-11-12-teleop")
    time, torque = log.series("T_GRAV")

``writer`` and ``reader`` write and read a file; ``schema`` defines the messages of
cycles, ``fields`` converts names of variables to names of fields; ``scan`` finds the
complete records in a truncated file.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
