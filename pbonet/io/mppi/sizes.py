"""Sizes and places in the variables of the kernels of `mppi_arm`."""

from __future__ import annotations

from typing import Final

JOINTS: Final = 12
"""Most joints of an arm."""
STEPS: Final = 100
"""Most steps of a plan."""
AXIS: Final = 9
"""Numbers of a joint's axis: its direction, a point on it, and the way of sliding."""
SETTINGS: Final = 16
STEP, NOISE, KEEP, FLOOR, NEAR, TEMPERATURE = range(6)
DISTANT, END, SPEED, EFFORT, POSTURE, INSIDE, BALL = range(6, 13)
"""Places in the settings; BALL is the first of four: x y z and radius, m."""
ODD: Final = 0x7FEB352D, 0x846CA68B
"""Factors that mix the bits of a word well (found by C. Wellons)."""
_WORD: Final = 0xFFFFFFFF


def key_of(seed: int) -> int:
    """Return a word that has little in common with that of the next seed."""
    word = seed & _WORD
    word ^= word >> 16
    word = word * ODD[0] & _WORD
    word ^= word >> 15
    word = word * ODD[1] & _WORD
    return word ^ word >> 16
