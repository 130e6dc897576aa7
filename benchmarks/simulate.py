"""How fast virtual time passes: seconds simulated by seconds taken.

Measures `simulate` (segments and response times kept) on sets of ten tasks
at and around 100 Hz, without module code; beside it the whole of `simulate_job`. The
median of five runs; the goal is 100 for the first line.

    python -m benchmarks.simulate [--seconds 20] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.analysis import legality
from pbonet.analysis.schedule.simulate import PeriodicTask, simulate
from pbonet.config.model import Rmod, RtpuEntry, SvarFile

if TYPE_CHECKING:
    from collections.abc import Callable

MS = 1_000_000
SECOND = 1000 * MS
GOAL = 100
RUNS = 5


def tasks(spread_ns: int, cost_ns: int = 700_000) -> list[PeriodicTask]:
    """Return ten tasks of 100 Hz, their periods `spread_ns` apart."""
    return [
        PeriodicTask(
            name=f"t{k}", period_ns=10 * MS + k * spread_ns, cost=cost_ns, priority=k
        )
        for k in range(10)
    ]


def speed(run: Callable[[], object], seconds: float) -> float:
    """Return virtual seconds by real ones, the median of several runs."""
    found: list[float] = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        run()
        found.append(seconds / (time.perf_counter() - begin))
    return statistics.median(found)


def job(seconds: float) -> None:
    """Run a configuration of ten tasks, from its verification data to the text."""
    made = [
        legality.Task(
            rmod=Rmod(name=f"t{k}", file="t.rmod", module="m", freq=100.0, maxc=0.0007),
            rtpu="arm0",
        )
        for k in range(10)
    ]
    configuration = legality.Configuration(
        svar=SvarFile(file="a.svar", defines={}, variables=()),
        tasks=tuple(made),
        on=frozenset(task.name for task in made),
        rtpus=(RtpuEntry(name="arm0"),),
    )
    legality.simulate_job(configuration, seconds=seconds).as_text()


def speeds(seconds: int) -> dict[str, float]:
    """Return how much faster than real time each case runs so many seconds."""
    return {
        "10 tasks at 100 Hz": speed(
            lambda: simulate(tasks(0), until_ns=seconds * SECOND), seconds
        ),
        "10 tasks around 100 Hz": speed(
            lambda: simulate(tasks(1000), until_ns=seconds * SECOND), seconds
        ),
        "10 tasks at 100 Hz, simulate_job with its text": speed(
            lambda: job(seconds), seconds
        ),
    }


def main() -> int:
    """Measure, print, and say whether the goal was met."""
    parser = argparse.ArgumentParser(description="Speed of virtual time.")
    parser.add_argument("--seconds", type=int, default=20, help="of virtual time")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    arguments = parser.parse_args()
    found = {"times real time": speeds(arguments.seconds)}
    for title, rows in found.items():
        print(title)
        for name, value in rows.items():
            print(f"  {name:50} {value:10.3g}")
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=1), encoding="utf-8")
    return 0 if found["times real time"]["10 tasks at 100 Hz"] >= GOAL else 3


if __name__ == "__main__":
    raise SystemExit(main())
