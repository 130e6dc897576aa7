"""Tasks of equal rate and rank on one core: what does each of them miss?

A real agent and master. Tasks of 1 kHz compute for a declared time in each cycle; their
criticality, deadline and user priority are equal, so the dispatcher ranks them in the
order in which they were created. What each missed stands in the dispatcher's own trace.
Then they are killed, and the same tasks are created in the reverse order: what depends
on the order changes sides, and what depends on a name or a variable does not.
A C loop above the dispatcher that only sleeps wakes up four times a period on the same
core: a miss is excused if it was late in that time, by an eighth of a period, because
the tasks leave more than that free. Every miss that is not excused is then explained by
the cycles' own records, the dispatcher's trace, and what the kernel counts: the tasks
themselves used the core; a turn of the dispatcher came late; a cycle under way lost the
core, which only the kernel or the hypervisor can take from it; or the dispatcher's
thread waited, or time was stolen. Ends with status 3 when a task lost a release that is
not excused, and says how many nothing explains.

    python -m benchmarks.equal_tasks [--tasks 4] [--load 0.63] [--seconds 30]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from benchmarks import rtbench, swap
from benchmarks.steering import VARIABLE
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.node import rt
from pbonet.node.ring import Ring
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


class Sample(NamedTuple):
    """What the kernel has counted up to an instant."""

    at_ns: int
    waited_ns: int
    """Time for which the dispatcher's thread was ready and did not run."""
    stolen: int
    """Ticks that the hypervisor took from the core."""


class Witnesses:
    """What is known about a core besides the misses.

    Args:
        core: Its number.
        rings: The rings of its tasks.
    """

    def __init__(self, core: int, rings: list[Ring]) -> None:
        self._core, self._rings = core, rings
        self._cycles: list[tuple[int, int, int]] = []
        """Start, end and CPU time."""
        with closing(rt.CoreTable(core, member=False)) as table:
            status = table.status()
        self._thread = Path(f"/proc/{status.leader_pid}/task/{status.leader_tid}")
        self._samples = [self._sample()]

    def look(self) -> None:
        """Take in what has happened since the last look."""
        self._samples.append(self._sample())
        for ring in self._rings:
            self._cycles += [
                (one.start_ns, one.end_ns, one.cpu_ns)
                for one in ring.drain()
                if not one.kind
            ]

    def _sample(self) -> Sample:
        try:
            waited = int((self._thread / "schedstat").read_text().split()[1])
        except OSError:
            waited = 0
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        line = next(one for one in lines if one.startswith(f"cpu{self._core} "))
        return Sample(time.monotonic_ns(), waited, int(line.split()[8]))

    def explain(self, begin: int, end: int, late_ns: int) -> str:
        """Return why a release in an interval was missed; empty if nothing says it.

        Args:
            begin: The release before.
            end: When it was missed.
            late_ns: By how much a turn of the dispatcher came late in that time.
        """
        least = swap.PERIOD // (2 * WAKES)
        inside = [one for one in self._cycles if one[1] > begin and one[0] < end]
        if self._used(inside, begin, end) >= 0.9 * (end - begin):
            return "the tasks used the core"
        if late_ns >= least:
            return "a turn came late"
        if any(
            e - s - self._used(inside, s, e) >= least
            for s, e, _ in inside
            if e - s >= least
        ):
            return "a cycle lost the core"
        for before, after in pairwise(self._samples):
            if before.at_ns <= end and after.at_ns >= begin:
                waited = after.waited_ns - before.waited_ns
                if waited >= least or after.stolen > before.stolen:
                    return "the kernel counted it"
        return ""

    @staticmethod
    def _used(cycles: list[tuple[int, int, int]], begin: int, end: int) -> float:
        """Return the CPU time of cycles within an interval."""
        return sum(
            cpu * max(0, min(e, end) - max(s, begin)) / max(e - s, 1)
            for s, e, cpu in cycles
        )


def measure(
    subsystem: Subsystem, folder: Path, tasks: tuple[str, ...], seconds: float
) -> dict[str, dict[str, int]]:
    """Return by task its releases, the missed ones, and why those not excused."""
    for task in tasks:
        subsystem.spawn(task, RTPU)
    subsystem.reconfig([(task, "on") for task in tasks])
    subsystem.wait(0.5)
    core = subsystem.clients.call(RTPU, Hello(), AgentInfo).core
    loop = swap.Stalls(folder, core, WAKES)
    traces = {task: swap.Trace(core, (task,)) for task in tasks}
    rings = [Ring.attach(one.ring) for one in subsystem.status_all()]
    witnesses = Witnesses(core, rings)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        subsystem.wait(0.2)
        for trace in traces.values():
            trace.look()
        witnesses.look()
    _, late = loop.end()
    turns = [turn for trace in traces.values() for turn in trace.turns]
    found: dict[str, dict[str, int]] = {}
    for task, trace in traces.items():
        lost = swap.unexcused(trace, late, swap.PERIOD // (2 * WAKES))
        found[task] = {
            "releases": trace.released,
            "missed": sum(count for _, count in trace.misses),
            "not excused": sum(count for _, _, count in lost),
            "unexplained": 0,
        }
        for begin, at, count in lost:
            late_ns = swap.most_late(turns, begin, at)
            late_ns = max(late_ns, (count - 1) * swap.PERIOD)  # found in one turn
            why = witnesses.explain(begin, at, late_ns)
            counts = found[task]
            counts[why or "unexplained"] = counts.get(why or "unexplained", 0) + count
        trace.close()
    for ring in rings:
        ring.close()
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
    shown = ("releases", "missed", "not excused", "unexplained")
    print(f"{'created':8} {'task':8} " + " ".join(f"{one:>12}" for one in shown))
    for found in both:
        for place, (task, counts) in enumerate(found.items(), 1):
            row = " ".join(f"{counts[one]:12}" for one in shown)
            why = ", ".join(f"{n} {k}" for k, n in counts.items() if k not in shown)
            print(f"{place:<8} {task:8} {row}  {why}")
    if asked.json:
        asked.json.write_text(json.dumps(both, indent=1), encoding="utf-8")
    if any(counts["not excused"] for found in both for counts in found.values()):
        sys.exit(3)  # see run.py


if __name__ == "__main__":
    main()
