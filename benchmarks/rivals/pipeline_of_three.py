"""A source, a middle and a sink at 1 kHz: how late a set is, and what all of it costs.

36 numbers of float64. The source notes the time, the middle passes on what comes, the
sink compares the time with the clock. The processor time is that of all processes that
a contestant starts, its daemons and agents too, and what sleeping costs is in it.
"""

from __future__ import annotations

import os
import secrets
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks.rivals import dora_dataflow, pbonet_tasks
from benchmarks.rivals.rival import installed

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

    from numpy.typing import NDArray

    Run = Callable[[Path, int, int, float], AbstractContextManager[None]]

RATE, WIDTH = 1000, 36
SETTLE = 1.0
MARK = "PBONET_RIVALS_RUN"
"""A word in the environment of all processes of a run, by which they are found."""
OURS, DORA = "pbonet", "dora"


class Block(NamedTuple):
    """What one run of a pipeline gave."""

    p50: float
    """Microseconds from the source's clock to the sink's."""
    p99: float
    share: float
    """Of the sets that the source sent, those that the sink saw."""
    core: float
    """Percent of a core, of all processes together."""


def cpu_ns(mark: str) -> int:
    """Return the processor time of all processes of a run."""
    word, total = f"{MARK}={mark}".encode(), 0
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if word not in (process / "environ").read_bytes().split(b"\0"):
                continue
            for thread in (process / "task").iterdir():
                total += int((thread / "schedstat").read_text().split()[0])
        except OSError:
            continue
    return total


def contestants(told: Callable[[str], None]) -> dict[str, Run]:
    """Return the pipelines that can run here, and tell of the others."""
    there: dict[str, Run] = {OURS: pbonet_tasks.running}
    if missing := [one for one in dora_dataflow.NEEDS if not installed(one)]:
        told(f"dora: skipped, {missing[0]} is not installed")
        return there
    there[DORA] = dora_dataflow.running
    return there


def measure(
    rounds: int, seconds: float, told: Callable[[str], None]
) -> dict[str, list[Block]]:
    """Run every pipeline in every round; return what each run gave.

    Raises:
        RuntimeError: That of pbonet did not run.
    """
    there = contestants(told)
    found: dict[str, list[Block]] = {name: [] for name in there}
    for number in range(rounds):
        told(f"pipelines, round {number + 1} of {rounds}")
        for name in [*there]:
            try:
                found[name].append(_run(there[name], seconds))
            except RuntimeError as error:
                if name == OURS:
                    raise
                told(f"{name}: skipped, {error}")
                del there[name], found[name]
    return found


def _run(running: Run, seconds: float) -> Block:
    """Run a pipeline once."""
    mark = secrets.token_hex(8)
    os.environ[MARK] = mark
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        with running(folder, RATE, WIDTH, SETTLE + seconds + SETTLE):
            time.sleep(SETTLE)
            before, begun = cpu_ns(mark), time.monotonic()
            time.sleep(seconds)
            used, passed = cpu_ns(mark) - before, time.monotonic() - begun
        seen: NDArray[np.float64] = np.load(folder / "seen.npy")
    p50, p99 = np.quantile(seen[:, 0], [0.5, 0.99]).tolist()
    sent = float(seen[-1, 1] - seen[0, 1]) + 1
    return Block(p50 / 1e3, p99 / 1e3, len(seen) / sent, used / passed / 1e7)
