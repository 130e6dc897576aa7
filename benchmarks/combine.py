"""Three modules apart and as one task (Stewart 1994, section 3.8.1).

The controller of ``examples/servoing``: forward kinematics, damped least squares and an
integrator, first as three tasks, then combined, over a real agent with the rest of the
example. CPU time, start and end of each cycle are read from the tasks' rings; what is
copied in a period is counted from the interfaces.

What one more module in a combination costs is measured in this process: a cycle of 16
modules that do nothing beside a cycle of two, in turns.

    python -m benchmarks.combine [--blocks 4] [--seconds 4] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from bisect import bisect_left, bisect_right
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import rtbench
from pbonet.errors import StateError
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.svar.layout import group_of
from pbonet.testing import Bench

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pbonet.log import Cycles

EXAMPLE = Path(__file__).parents[1] / "examples" / "servoing"
CHAINS = {"damped": ("forward_kin", "damped_ls", "qrint"), "combined": ("servo",)}
"""The tasks of the controller, in the order of the data, by job."""
PARTS = 16
CYCLES = 20_000
OTHER = 16 << 20
"""Bytes that are gone through between two cycles."""
MOST_A_PART = 1.0
"""Goal: microseconds that one more module in a combination costs in a cycle."""
SETTLE = 1.0
"""Seconds that are left out at the begin of each run."""


def record(job: str, seconds: float) -> tuple[Cycles, dict[str, float]]:
    """Run a job; return every cycle, and what its controller copies."""
    with Subsystem(EXAMPLE / f"{job}.job", warned=lambda _text: None) as arm:
        arm.start()
        time.sleep(SETTLE + seconds)
        copies = transfers(arm, CHAINS[job])
        recording = arm.recordings.finish(arm.clients)
        if recording is None:
            raise StateError("nothing was recorded", where=job)
        return recording, copies


def transfers(arm: Subsystem, tasks: Sequence[str]) -> dict[str, float]:
    """Return transfers and bytes in a period of some tasks."""
    table = arm.files.table.variables
    numbers = {variable.name: i for i, variable in enumerate(table)}
    moved = 0
    for name in tasks:
        task = arm.model.find(name).task
        for names in (task.inputs, task.outputs):
            moved += group_of(table, [numbers[one] for one in names]).bytes
    return {"transfers a period": 2.0 * len(tasks), "bytes a period": float(moved)}


def figures(recording: Cycles, tasks: Sequence[str]) -> dict[str, list[float]]:
    """Return CPU time of a period and the way of the data through it."""
    cycles = [recording.arrays(task) for task in tasks]
    begin = max(one["release_ns"][0] for one in cycles) + int(SETTLE * 1e9)
    cycles = [_after(one, begin) for one in cycles]
    length = min(len(one["cpu_ns"]) for one in cycles)
    cpu = np.sum([one["cpu_ns"][:length] for one in cycles], axis=0) / 1e3
    way, periods = _way(cycles)
    return {"CPU us": list(cpu), "way us": way, "way periods": periods}


def _after(arrays: Any, begin_ns: int) -> dict[str, Any]:  # noqa: ANN401 - columns by name
    kept = arrays["release_ns"] >= begin_ns
    return {name: values[kept].tolist() for name, values in arrays.items()}


def _way(cycles: Sequence[dict[str, Any]]) -> tuple[list[float], list[float]]:
    """Follow the data of each first cycle to the end of the last task that uses them.

    A task takes in what was committed before it began. Returns microseconds from the
    begin of the first cycle to the end of the last, and releases of the last task that
    passed by meanwhile.
    """
    micros: list[float] = []
    periods: list[float] = []
    first, *rest = cycles
    for start, end in zip(first["start_ns"], first["end_ns"], strict=True):
        at, last = end, first
        for later in rest:
            index = bisect_left(later["start_ns"], at)
            if index == len(later["start_ns"]):
                return micros, periods
            at, last = later["end_ns"][index], later
        micros.append((at - start) / 1e3)
        releases = last["release_ns"]
        passed = bisect_right(releases, at) - bisect_right(releases, start)
        periods.append(float(passed))
    return micros, periods


def measure(blocks: int, seconds: float) -> dict[str, dict[str, Any]]:
    """Run both in turn; return what was measured of each."""
    found: dict[str, dict[str, Any]] = {job: {} for job in CHAINS}
    with tempfile.TemporaryDirectory() as name:
        os.environ["PBONET_RUN_DIR"] = f"{name}/run"
        with Embedded("default") as agents:
            agents.start(["arm0", "arm1"])
            for _ in range(blocks):
                for job, tasks in CHAINS.items():
                    recording, copies = record(job, seconds)
                    for what, values in figures(recording, tasks).items():
                        found[job].setdefault(what, []).append(values)
                    found[job] |= copies
    return found


_PART = """
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject


class Part(PortBasedObject, freq=100):
    \"\"\"Does nothing.\"\"\"

    x: A[float, InVar("X", "1", "m", "what comes in")]
    y: A[float, OutVar("Y", "1", "m", "what goes out")]

    def cycle(self, dt: float) -> None:
        pass
"""


def chained(folder: Path, count: int) -> Callable[[float], None]:
    """Return the cycle of a combination of so many modules, in a row."""
    names = [f"part{count}x{k}" for k in range(count)]
    for k, name in enumerate(names):
        (folder / f"{name}.py").write_text(_PART, encoding="utf-8")
        own = f"MODULE {name}\nDESC nothing\nSVARALIAS X=V{k}\nSVARALIAS Y=V{k + 1}\n"
        own += "INCONST none\nOUTCONST none\nINVAR X\nOUTVAR Y\n"
        own += "TASKTYPE periodic\nFREQ 100\nEOF\n"
        (folder / f"{name}.rmod").write_text(own, encoding="utf-8")
    whole = folder / f"whole{count}.rmod"
    whole.write_text(
        f"COMBINE {' '.join(names)}\nDESC nothing at all\nINCONST none\nOUTCONST none\n"
        f"INVAR V0\nOUTVAR V{count}\nTASKTYPE periodic\nFREQ 100\nEOF\n",
        encoding="utf-8",
    )
    bench = Bench.of(whole, library=[folder])
    bench.on()
    return partial(type(bench.module).cycle, bench.module)  # the bench's notes it


def part_costs(blocks: int) -> dict[str, list[float]]:
    """Return the microseconds of one more module in a combination, by block.

    In a row nothing else runs between two cycles; apart, as in a task, what they use
    has left the caches of the core.
    """
    found: dict[str, list[float]] = {"in a row": [], "apart": []}
    other = np.zeros(OTHER // 8)
    with tempfile.TemporaryDirectory() as name:
        cycles = [chained(Path(name), count) for count in (2, PARTS)]
        for _ in range(max(blocks, 3)):
            few, many = (_in_a_row(cycle) for cycle in cycles)
            found["in a row"].append((many - few) / (PARTS - 2))
            few, many = (_apart(cycle, other) for cycle in cycles)
            found["apart"].append((many - few) / (PARTS - 2))
    return found


def _in_a_row(cycle: Callable[[float], None]) -> float:
    begun = time.thread_time_ns()
    for _ in range(CYCLES):
        cycle(0.01)
    return (time.thread_time_ns() - begun) / CYCLES * 1e-3


def _apart(cycle: Callable[[float], None], other: NDArray[np.float64]) -> float:
    """Return the median, which an interruption does not change."""
    spent: list[float] = []
    for _ in range(CYCLES // 100):
        other += 1.0
        begun = time.perf_counter_ns()
        cycle(0.01)
        spent.append((time.perf_counter_ns() - begun) * 1e-3)
    return statistics.median(spent)


def rows(found: dict[str, dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """Return the lines of the report: what, and its text apart and combined."""
    lines = [
        (what, [f"{found[job][what]:g}" for job in CHAINS])
        for what in ("transfers a period", "bytes a period")
    ]
    for what in ("CPU us", "way us", "way periods"):
        for name, share in (("p50", 0.5), ("p99", 0.99)):
            texts: list[str] = []
            for job in CHAINS:
                each = [
                    float(np.quantile(np.asarray(one, np.float64), share))
                    for one in found[job][what]
                ]
                texts.append(
                    f"{np.median(each):.1f} [{min(each):.1f}, {max(each):.1f}]"
                )
            lines.append((f"{what} {name}", texts))
    return lines


def main() -> None:
    """Measure, report, and judge."""
    parser = argparse.ArgumentParser(description="Modules apart and combined.")
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    print(rtbench.machine())
    parts = part_costs(args.blocks)
    found = measure(args.blocks, args.seconds)
    print(f"{args.blocks} blocks of {args.seconds:g} s each; medians of the blocks'")
    print("quantiles [least, greatest]")
    print(f"{'':24}{'apart':>26}{'combined':>26}")
    for what, texts in rows(found):
        print(f"{what:24}" + "".join(f"{text:>26}" for text in texts))
    print("us of one more module in a combination: median [least, greatest] of blocks")
    for how, values in parts.items():
        print(f"{how:24}{rtbench.spread(values, 3)}")
    if args.json:
        data = {**found, "us of one more module": parts}
        args.json.write_text(json.dumps(data, indent=1), encoding="utf-8")
    told = rtbench.verdict(
        "one more module in a combination, apart, in us",
        statistics.median(parts["apart"]),
        MOST_A_PART,
    )
    rtbench.judge([told])


if __name__ == "__main__":
    main()
