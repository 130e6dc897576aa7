"""Tasks of equal rate and rank on one core: what does each of them miss?

A real agent and master. Tasks of 1 kHz compute for a declared time in each cycle; their
criticality, deadline and user priority are equal, so the dispatcher ranks them in the
order in which they were created. What each missed stands in the dispatcher's own trace.
Then they are killed, and the same tasks are created in the reverse order: what depends
on the order changes sides, and what depends on a name or a variable does not.
A C loop above the dispatcher that only sleeps wakes up four times a period on the same
core: a miss is excused if it was late in that time, by an eighth of a period, because
the tasks leave more than that free. Ends with status 3 when a task lost a release that
is not excused.

    python -m benchmarks.equal_tasks [--tasks 4] [--load 0.63] [--seconds 30]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import rtbench, swap
from benchmarks.steering import VARIABLE
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.xm.net.messages import AgentInfo, Hello

RTPU = "bench0"
WAKES = 4
MOST_LOAD = 0.8
"""A stall that no wake-up of the loop sees must not be able to cost a release."""
MODULE = """\
import time
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, param


class Work(Params):
    used: A[float, param("s", "CPU time of a cycle")] = 0.0


class Computes(PortBasedObject[Work]):
    \"\"\"Uses CPU time.\"\"\"

    y: A[float, OutVar("Y", "1", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y += 1.0
        end = time.thread_time_ns() + round(self.params.used * 1e9)
        while time.thread_time_ns() < end:
            pass
"""
RMOD = """\
MODULE    computes
DESC      of the benchmark
SVARALIAS Y={variable}
INCONST   none
OUTCONST  none
INVAR     none
OUTVAR    Y
TASKTYPE  periodic
FREQ      {rate:g}
LOCAL
USED      {used:g}
EOF
"""


def write_files(folder: Path, tasks: tuple[str, ...], used: float) -> Path:
    """Write the module and the subsystem; return its ``.sbs`` file."""
    names = [f"Y{number}" for number in range(len(tasks))]
    variables = [
        VARIABLE.format(name=name, kind="double", units="none", nelem=1)
        for name in names
    ]
    (folder / "computes.py").write_text(MODULE, encoding="utf-8")
    (folder / "b.svar").write_text("\n".join(variables) + "\nEOF\n", encoding="utf-8")
    (folder / "b.sbs").write_text(
        f"SUBSYSTEM b\nSVARFILE b.svar\nRTPU {RTPU}\nEOF\n", encoding="utf-8"
    )
    for task, variable in zip(tasks, names, strict=True):
        text = RMOD.format(variable=variable, rate=swap.RATE, used=used)
        (folder / f"{task}.rmod").write_text(text, encoding="utf-8")
    return folder / "b.sbs"


def measure(
    subsystem: Subsystem, folder: Path, tasks: tuple[str, ...], seconds: float
) -> dict[str, dict[str, int]]:
    """Return by task its releases, the ones it missed, and those not excused."""
    for task in tasks:
        subsystem.spawn(task, RTPU)
    subsystem.reconfig([(task, "on") for task in tasks])
    subsystem.wait(0.5)
    core = subsystem.clients.call(RTPU, Hello(), AgentInfo).core
    loop = swap.Stalls(folder, core, WAKES)
    traces = {task: swap.Trace(core, (task,)) for task in tasks}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        subsystem.wait(0.2)
        for trace in traces.values():
            trace.look()
    _, late = loop.end()
    found: dict[str, dict[str, int]] = {}
    for task, trace in traces.items():
        lost = swap.unexcused(trace, late, swap.PERIOD // (2 * WAKES))
        found[task] = {
            "releases": trace.released,
            "missed": sum(count for _, count in trace.misses),
            "not excused": sum(count for _, _, count in lost),
        }
        trace.close()
    subsystem.reconfig([(task, "kill") for task in tasks])
    return found


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tasks", type=int, default=4)
    parser.add_argument("--load", type=float, default=0.63, help="of all, at most 0.8")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each order")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if not 0.0 <= asked.load <= MOST_LOAD:
        parser.error(f"--load: expected 0 to {MOST_LOAD:g}, got {asked.load:g}")
    tasks = tuple(f"task{number + 1}" for number in range(asked.tasks))
    swap.STAY = tasks
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        sbs = write_files(folder, tasks, asked.load / asked.tasks / swap.RATE)
        with Embedded("default", libraries=[str(folder)]) as agents:
            agents.start([RTPU])
            with Subsystem(sbs, warned=lambda _text: None, record="off") as subsystem:
                both = [
                    measure(subsystem, folder, order, asked.seconds)
                    for order in (tasks, tasks[::-1])
                ]
    print(rtbench.machine())
    print(
        f"{asked.tasks} tasks of {swap.RATE:g} Hz, {asked.load:.0%} of a core together"
    )
    print(f"{'created':8} {'task':8} {'releases':>9} {'missed':>7} {'not excused':>12}")
    for found in both:
        for place, (task, counts) in enumerate(found.items(), 1):
            print(f"{place:<8} {task:8} {counts['releases']:9} {counts['missed']:7} "
                  f"{counts['not excused']:12}")  # fmt: skip
    if asked.json:
        asked.json.write_text(json.dumps(both, indent=1), encoding="utf-8")
    if any(counts["not excused"] for found in both for counts in found.values()):
        sys.exit(3)  # see run.py


if __name__ == "__main__":
    main()
