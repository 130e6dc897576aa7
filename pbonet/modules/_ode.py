"""Linear differential equations, solved exactly over a step."""

from __future__ import annotations

import numpy as np

from pbonet import Matrix


def propagator(matrix: Matrix, dt: float) -> Matrix:
    """Return exp(matrix dt): what takes the state of z' = matrix z over a step.

    By its Taylor series, after so many halvings of the step that the series ends within
    the precision of numbers, and as many squarings (Moler and Van Loan 2003, method 3).

    Args:
        matrix: Square, or a stack of square ones, [..., n, n].
        dt: The step, s.
    """
    scaled = np.asarray(matrix, dtype=np.float64) * dt
    size = float(np.abs(scaled).sum(axis=-1).max())
    halvings = max(0, int(np.ceil(np.log2(max(size, 1e-300)))) + 1)
    scaled = scaled / 2.0**halvings
    term = np.broadcast_to(np.eye(scaled.shape[-1]), scaled.shape).copy()
    total = term.copy()
    for k in range(1, _TERMS):
        term = term @ scaled / k
        total += term
    for _ in range(halvings):
        total = total @ total
    return total


_TERMS = 16
"""0.5^16 / 16! is 1e-18."""
