"""Three modules apart and as one task (Stewart 1994, section 3.8.1).

The controller of ``examples/servoing``: forward kinematics, damped least squares and an
integrator, first as three tasks, then combined, over a real agent with the rest of the
example. CPU time, start and end of each cycle are read from the tasks' rings; what is
copied in a period is counted from the interfaces.

    python -m benchmarks.combine [--blocks 4] [--seconds 4] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from bisect import bisect_left, bisect_right
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import rtbench
from pbonet.errors import StateError
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.svar.layout import group_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.log import Cycles

EXAMPLE = Path(__file__).parents[1] / "examples" / "servoing"
CHAINS = {"damped": ("forward_kin", "damped_ls", "qrint"), "combined": ("servo",)}
"""The tasks of the controller, in the order of the data, by job."""
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
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Modules apart and combined.")
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = measure(args.blocks, args.seconds)
    print(rtbench.machine())
    print(f"{args.blocks} blocks of {args.seconds:g} s each; medians of the blocks'")
    print("quantiles [least, greatest]")
    print(f"{'':24}{'apart':>26}{'combined':>26}")
    for what, texts in rows(found):
        print(f"{what:24}" + "".join(f"{text:>26}" for text in texts))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
