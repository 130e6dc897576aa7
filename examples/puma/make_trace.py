"""Write the operator trace `puma`, which the example plays where no ball is connected.

    python examples/puma/make_trace.py

The trace is what a Magellan would have sent while somebody pushed and turned it for
15 s: a packet every 40 ms while it is pushed, one packet when it comes to rest, silence
while it rests. Every push is answered later by its opposite, so that the arm ends where
it began and the trace can be repeated. A hand is never quite still; its tremor (a few
counts, from a fixed seed) lies inside the dead zone of `jtball`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbonet.io.magellan import NIBBLES

TARGET = Path(__file__).parents[2] / "pbonet" / "io" / "traces" / "puma.trace"
LENGTH = 15.0
"""Seconds."""
INTERVAL = 0.04
"""Seconds between packets."""
TREMOR = 3.0
"""Counts."""
PUSHES = [
    # axis, begin (s), length (s), largest deflection (counts)
    (0, 0.6, 3.2, 330),
    (5, 1.2, 2.4, 260),
    (1, 2.4, 2.6, -280),
    (2, 2.8, 2.4, 340),
    (4, 4.6, 2.0, -300),
    (3, 5.2, 2.2, 360),
    (0, 7.4, 3.2, -330),
    (2, 7.8, 2.4, -340),
    (1, 8.4, 2.6, 280),
    (3, 9.6, 2.2, -360),
    (5, 11.2, 2.4, -260),
    (4, 11.6, 2.0, 300),
]


def push(t: float, begin: float, length: float) -> float:
    """Return how far a push has gone at `t`: 0 to 1 and back, smoothly."""
    phase = (t - begin) / length
    return float(np.sin(np.pi * phase) ** 2) if 0.0 < phase < 1.0 else 0.0


def deflection(t: float, rng: np.random.Generator) -> list[int]:
    """Return the six axes at `t`, in counts; all zero when nobody pushes."""
    axes = np.zeros(6)
    for axis, begin, length, size in PUSHES:
        axes[axis] += size * push(t, begin, length)
    if not axes.any():
        return [0] * 6
    return [round(value) for value in axes + rng.normal(0.0, TREMOR, 6)]


def motion_packet(axes: list[int]) -> str:
    """Return the packet that says `axes`."""
    digits = "".join(f"{value + 0x8000:04x}" for value in axes)
    return "d" + "".join(chr(NIBBLES[int(digit, 16)]) for digit in digits)


def lines() -> list[str]:
    """Return the trace."""
    rng = np.random.default_rng(1994)
    text = [
        "# A Magellan pushed for 15 s; written by examples/puma/make_trace.py",
        f"0.000 {motion_packet([0] * 6)}",
    ]
    resting = True
    for k in range(1, round(LENGTH / INTERVAL)):
        axes = deflection(k * INTERVAL, rng)
        if any(axes) or not resting:
            text.append(f"{k * INTERVAL:.3f} {motion_packet(axes)}")
        resting = not any(axes)
    return [*text, f"{LENGTH:.3f} end"]


if __name__ == "__main__":
    TARGET.write_text("\n".join(lines()) + "\n", encoding="ascii")
