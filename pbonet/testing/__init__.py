"""Tests of modules: a bench that steps one module in virtual time.

::

    bench = Bench(JointPID, params=Gains(kp=10.0, limit=5.0), ndof=2)
    bench.on()
    bench.inputs.q_ref = [0.1, 0.0]
    bench.step(0.002)
    assert bench.outputs.tau == approx([1.0, 0.0])

The bench runs the module through the same executor as a task, with the copies of
section 3.6 before and after each method, but in one thread, without shared memory and
without waiting. What it calls ``inputs`` and ``outputs`` is the global table: a module
sees an input when it is copied in, and an output appears when it is copied out.

A run that was recorded is a test too: `replay` runs a task's code again on its log.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
