"""Release jitter of a 1 kHz task, beside a C loop on clock_nanosleep.

Both stand at the same SCHED_FIFO level on the same core and take turns, block by
block, so that whatever else the machine does hits both alike. The task reads the clock
in the first line of its ``cycle``; before that its six inputs of six numbers are copied
in, and its outputs are committed afterwards. Given are the median of the blocks'
quantiles with the least and the greatest, and the same of neighbouring blocks' ratios.

With ``--tasks`` others of 100 Hz with the same ports run on the core beside the task;
the C loop always has it alone. With ``--checks`` a third block follows in every turn,
in which everything is looked after: MAXC and MINC declared, a handler with a
criticality of its own, for all tasks. Status 3: a goal was missed.

    python -m benchmarks.jitter [--blocks 7] [--seconds 4] [--tasks 1] [--checks]
        [--core 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from benchmarks import rtbench
from pbonet.node import rt

if TYPE_CHECKING:
    from collections.abc import Iterator

QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
GOALS = {"p50": 1.6, "p99": 1.7}
"""Of the C loop's delay, the median of the blocks' ratios; of the others none."""
WARM_UP = 200
"""Cycles that are run and not counted."""
OTHERS_NS = 10_000_000
"""Period of the other tasks."""


class Rig(NamedTuple):
    """What is measured with."""

    core: rt.CoreTable
    tables: rtbench.Tables
    dispatcher: rt.Dispatcher
    period: int
    cycles: int


class Block(NamedTuple):
    """Delays in nanoseconds, and how many releases were missed."""

    delays: np.ndarray
    missed: int


def run_task(rig: Rig, *, checks: bool) -> Block:
    """Measure one block of the task."""
    core, cycles = rig.core, rig.cycles
    slot = core.alloc("bench", "jitter")
    core.configure(slot, period_ns=rig.period, crit=5, priority=99)
    rtbench.watch(core, slot, rig.period, on=checks)
    with tempfile.TemporaryFile() as file:
        out = np.memmap(file, dtype=np.int64, mode="w+", shape=(cycles + 3,))
        out[:] = 0

        def body(end: rt.Slot) -> None:
            local, now = rig.tables.local(0), time.monotonic_ns
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

            end.run(cycle, local, failing=lambda _kind: rt.CONTINUE)

        pid = rtbench.start_task(core, slot, body)
        bound = 10 + 3e-9 * rig.period * (cycles + WARM_UP)
        rtbench.wait_for(lambda: bool(out[cycles]), "all cycles were run", bound)
        rtbench.end_task(core, slot, pid)
        return Block(np.array(out[:cycles]), int(out[cycles + 1] - out[cycles + 2]))


def start_others(rig: Rig, count: int) -> dict[int, int]:
    """Start `count` other tasks, of slightly different periods; pids by slot."""
    started: dict[int, int] = {}
    for k in range(1, count + 1):
        slot = rig.core.alloc("bench", f"other{k}")
        rig.core.configure(slot, period_ns=OTHERS_NS + 7919 * k, crit=5, priority=k)

        def body(end: rt.Slot, k: int = k) -> None:
            end.run(
                lambda _dt: None,
                rig.tables.local(k),
                failing=lambda _kind: rt.CONTINUE,
            )

        started[slot] = rtbench.start_task(rig.core, slot, body)
    return started


def quantiles(delays: np.ndarray) -> dict[str, float]:
    """Return the quantiles in microseconds."""
    return {name: float(np.quantile(delays, q)) / 1e3 for name, q in QUANTILES.items()}


def measure(
    rig: Rig, loop: Path, args: argparse.Namespace, tasks: int
) -> dict[str, list[Block]]:
    """Return the blocks of each rival, with `tasks` tasks on the core.

    The other tasks sleep while no dispatcher leads, so the C loop has the core alone.
    """
    level = rtbench.LEVEL if rig.dispatcher.backend == "fifo" else 0
    modes = {"pbonet": False, "all checks": True} if args.checks else {"pbonet": False}
    found: dict[str, list[Block]] = {"C loop": [], **{mode: [] for mode in modes}}
    others = start_others(rig, tasks - 1)
    for _ in range(args.blocks):
        c = rtbench.run_loop(loop, args.core, level, rig.period, rig.cycles)
        found["C loop"].append(Block(c.delays, c.missed))
        for mode, checks in modes.items():
            for slot in others:
                rtbench.watch(rig.core, slot, OTHERS_NS, on=checks)
            rig.dispatcher.start()
            found[mode].append(run_task(rig, checks=checks))
            rig.dispatcher.stop()
    for slot, pid in others.items():
        rtbench.end_task(rig.core, slot, pid)
    return found


def report(found: dict[str, list[Block]]) -> dict[str, object]:
    """Print the table and return what it says."""
    result: dict[str, object] = {
        f"missed {name}": sum(block.missed for block in blocks)
        for name, blocks in found.items()
    }
    print(", ".join(f"{what} {count}" for what, count in result.items()))
    names = [name for name in found if name != "C loop"]
    head = [f"{name}, us" for name in found] + [f"{name} / C loop" for name in names]
    print(" " * 6 + " ".join(f"{title:>27}" for title in head))
    per_block = {n: [quantiles(b.delays) for b in found[n]] for n in found}
    for quantile in QUANTILES:
        values = {name: [q[quantile] for q in per_block[name]] for name in found}
        c = values["C loop"]
        ratios = {
            name: [b / a for a, b in zip(c, values[name], strict=True)]
            for name in names
        }
        cells = [rtbench.spread(values[name], 1) for name in found]
        cells += [rtbench.spread(ratios[name], 2) for name in names]
        print(f"{quantile:6}" + " ".join(cells))
        result[quantile] = values | {
            f"ratio {name}": statistics.median(ratios[name]) for name in names
        }
    return result


def goals(result: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each goal, of the reports by their number of tasks."""
    for tasks, found in result.items():
        for quantile, most in GOALS.items():
            for name, ratio in found[quantile].items():
                if name.startswith("ratio "):
                    mode = name.removeprefix("ratio ")
                    what = f"{tasks}: {quantile}, {mode} / C loop"
                    yield rtbench.verdict(what, ratio, most)


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Release jitter of one task.")
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--tasks", type=int, nargs="+", default=[1])
    parser.add_argument("--checks", action="store_true")
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--period-us", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    period = args.period_us * 1000
    cycles = int(args.seconds * 1e9 / period)
    core, tables = rt.CoreTable(args.core), rtbench.Tables(max(args.tasks))
    dispatcher = rt.Dispatcher(core)
    rig = Rig(core, tables, dispatcher, period, cycles)
    result: dict[str, Any] = {}
    print(rtbench.machine())
    print(
        f"back end {dispatcher.backend}, {args.blocks} blocks of {cycles} cycles each"
    )
    try:
        with tempfile.TemporaryDirectory() as folder:
            loop = rtbench.compile_c("clockloop", Path(folder))
            for tasks in args.tasks:
                print(f"\n{tasks} tasks; releases: ", end="")
                result[f"{tasks} tasks"] = report(measure(rig, loop, args, tasks))
    finally:
        dispatcher.stop()
        core.close()
        tables.table.destroy()
    if args.json:
        told = {"machine": rtbench.machine(), **result}
        args.json.write_text(json.dumps(told, indent=1), encoding="utf-8")
    print()
    rtbench.judge(goals(result))


if __name__ == "__main__":
    main()
