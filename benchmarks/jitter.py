"""Release jitter of one 1 kHz task, beside a C loop on clock_nanosleep.

Both stand at the same SCHED_FIFO level on the same core and take turns, block by
block, so that whatever else the machine does hits both alike. The task reads the clock
in the first line of its ``cycle``; before that its six inputs of six numbers are copied
in, and its outputs are committed afterwards. Given are the median of the blocks'
quantiles with the least and the greatest, and the same of neighbouring blocks' ratios.

    python -m benchmarks.jitter [--blocks 7] [--seconds 4] [--core 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import rtbench
from pbonet.node import _rt

QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
WARM_UP = 200
"""Cycles that are run and not counted."""


def run_task(
    core: _rt.CoreTable, tables: rtbench.Tables, period: int, cycles: int
) -> tuple[np.ndarray, int]:
    """Return a task's delays in nanoseconds, and how many releases it missed."""
    slot = core.alloc("bench", "jitter")
    core.configure(slot, period_ns=period, crit=5)
    with tempfile.TemporaryFile() as file:
        out = np.memmap(file, dtype=np.int64, mode="w+", shape=(cycles + 3,))
        out[:] = 0

        def body(end: _rt.Slot) -> None:
            local, now = tables.local(0), time.monotonic_ns
            delays, count = out.data, -WARM_UP

            def cycle(_dt: float) -> None:
                nonlocal count
                at = now()
                if 0 <= count < cycles:
                    delays[count] = at - end.release_ns
                elif count == cycles:
                    delays[cycles + 1] = end.missed
                    delays[cycles] = 1
                count += 1
                if count == 0:
                    delays[cycles + 2] = end.missed

            end.run(cycle, local)

        pid = rtbench.start_task(core, slot, body)
        bound = 10 + 3e-9 * period * (cycles + WARM_UP)
        rtbench.wait_for(lambda: bool(out[cycles]), "all cycles were run", bound)
        rtbench.end_task(core, slot, pid)
        return np.array(out[:cycles]), int(out[cycles + 1] - out[cycles + 2])


def quantiles(delays: np.ndarray) -> dict[str, float]:
    """Return the quantiles in microseconds."""
    return {name: float(np.quantile(delays, q)) / 1e3 for name, q in QUANTILES.items()}


def spread(values: list[float], digits: int) -> str:
    """Return the median, the least and the greatest."""
    low, high = min(values), max(values)
    return (
        f"{statistics.median(values):9.{digits}f} "
        f"[{low:7.{digits}f} {high:8.{digits}f}]"
    )


def report(
    blocks: list[tuple[dict[str, float], dict[str, float]]],
) -> dict[str, object]:
    """Print the table and return what it says."""
    result: dict[str, object] = {}
    print(f"{'':6}{'C loop, us':>27} {'pbonet, us':>27} {'ratio':>27}")
    for name in QUANTILES:
        c, p = [b[0][name] for b in blocks], [b[1][name] for b in blocks]
        ratios = [b / a for a, b in zip(c, p, strict=True)]
        print(f"{name:6}{spread(c, 1)} {spread(p, 1)} {spread(ratios, 2)}")
        result[name] = {"c": c, "pbonet": p, "ratio": statistics.median(ratios)}
    return result


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Release jitter of one task.")
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--period-us", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    period = args.period_us * 1000
    cycles = int(args.seconds * 1e9 / period)
    core, tables = _rt.CoreTable(args.core), rtbench.Tables(1)
    dispatcher = _rt.Dispatcher(core)
    level = rtbench.LEVEL if dispatcher.backend == "fifo" else 0
    blocks: list[tuple[dict[str, float], dict[str, float]]] = []
    missed = [0, 0]
    try:
        with tempfile.TemporaryDirectory() as folder:
            loop = rtbench.compile_loop(Path(folder))
            for _ in range(args.blocks):
                c = rtbench.run_loop(loop, args.core, level, period, cycles)
                dispatcher.start()
                delays, lost = run_task(core, tables, period, cycles)
                dispatcher.stop()
                missed = [missed[0] + c.missed, missed[1] + lost]
                blocks.append((quantiles(c.delays), quantiles(delays)))
    finally:
        dispatcher.stop()
        core.close()
        tables.table.destroy()
    print(rtbench.machine())
    print(
        f"back end {dispatcher.backend}, {args.blocks} blocks of {cycles} cycles each; "
        f"releases missed: C loop {missed[0]}, pbonet {missed[1]}"
    )
    result = report(blocks) | {"machine": rtbench.machine(), "missed": missed}
    if args.json:
        args.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
