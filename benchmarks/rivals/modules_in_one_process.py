"""One more module in a process: what it adds to a step.

The same law, y += 0.1 * (x - y) on six numbers in numpy, two times and eighteen times
in a chain; the difference of both, divided by sixteen, is what one more costs, with its
law. How a system as a whole is run differs, so that its own cost is not compared. All
times are the processor's, so that other programs on the machine change them little.
"""

from __future__ import annotations

import tempfile
import time
import timeit
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.rivals import combined_modules, drake_diagram
from benchmarks.rivals.rival import installed

if TYPE_CHECKING:
    from collections.abc import Callable

FEW, MANY, WIDTH = 2, 18, 6
STEPS = 1000
CLOCK = time.process_time
OURS, DRAKE, LAW = "pbonet, modules combined", "Drake, leaf systems", "the law alone"


def measure(rounds: int, told: Callable[[str], None]) -> dict[str, list[float]]:
    """Return microseconds of one more module, of each round, by contestant."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        steps = {OURS: [combined_modules.chain(n, WIDTH, folder) for n in (FEW, MANY)]}
        if installed(drake_diagram.PACKAGE):
            steps[DRAKE] = [drake_diagram.chain(n, WIDTH) for n in (FEW, MANY)]
        else:
            told(f"Drake: skipped, {drake_diagram.PACKAGE} is not installed")
        found: dict[str, list[float]] = {}
        for _ in range(rounds):
            for contestant, (few, many) in steps.items():
                spent = [
                    min(timeit.repeat(one, timer=CLOCK, number=STEPS, repeat=3))
                    for one in (few, many)
                ]
                each = (spent[1] - spent[0]) / (MANY - FEW) / STEPS * 1e6
                found.setdefault(contestant, []).append(each)
            found.setdefault(LAW, []).append(_law())
    return found


def _law() -> float:
    """Return microseconds of the law by itself."""
    setup = f"import numpy as np; x, y = np.ones({WIDTH}), np.zeros({WIDTH})"
    law = timeit.Timer("y += 0.1 * (x - y)", setup, timer=CLOCK)
    return min(law.repeat(number=STEPS, repeat=3)) / STEPS * 1e6
