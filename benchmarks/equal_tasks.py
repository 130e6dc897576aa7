"""Tasks of equal rate and rank on one core: what does each of them miss?

A real agent and master. Tasks of 1 kHz compute for a declared time in each cycle; their
criticality, deadline and user priority are equal, so the dispatcher ranks them in the
order in which they were created. What each missed stands in the dispatcher's own trace.
Then they are killed, and the same tasks are created in the reverse order: what depends
on the order changes sides, and what depends on a name or a variable does not.
In turns with them, block by block, run as many processes in C that use as much CPU
time at the same releases under plain SCHED_FIFO, each a level below the one before.
What they miss, a machine takes from anybody who needs the core for so long.
All that time a C loop above the dispatcher that only sleeps wakes up four times a
period on the same core: a miss, of either kind of tasks, is excused if it was late in
that time, by an eighth of a period, because the tasks leave more than that free. Every
miss of pbonet's that is not excused is then explained by the cycles' own records: they
say whether the cycles of the period used more CPU time than usual, lost the core while
under way, or began late, the first or a later one. If none of these took a quarter of
the time that a period has left more than usual, the miss is unexplained. This says
where the time of a period went, not who had the core. Ends with status 3 when a greater
share is missed than by the processes in C, excused misses apart, when a miss is
unexplained, or when records were lost, so that misses may be counted nowhere.

    python -m benchmarks.equal_tasks [--tasks 4] [--load 0.63] [--seconds 30]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks import rtbench, swap
from benchmarks.steering import VARIABLE
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.node.ring import Ring
from pbonet.xm.net.messages import AgentInfo, Hello

RTPU = "bench0"
WAKES = 4
LATE = swap.PERIOD // (2 * WAKES)
"""So many nanoseconds late the loop must have been to excuse a miss."""
BLOCK = 5.0
"""Seconds for which tasks and processes in C take turns."""
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


class Asked(NamedTuple):
    """What is measured."""

    used: float
    """Seconds of CPU time for a cycle."""
    seconds: float
    """For which each order runs, and the processes in C as well."""


class Parts(NamedTuple):
    """Where the time of a period went, in nanoseconds, up to the end of its cycles."""

    used: float
    """CPU time of cycles."""
    lost: float
    """Of cycles under way, in which they had no CPU time."""
    late: float
    """Until the first cycle began."""
    between: float
    """Between cycles."""

    def above(self, usual: Parts) -> Parts:
        """Return how much longer they took than usual."""
        return Parts(*(mine - theirs for mine, theirs in zip(self, usual, strict=True)))


REASONS = (
    "cycles used more CPU time",
    "a cycle lost the core",
    "the first began late",
    "a later one began late",
)
"""What it means that the parts, in their order, are longer than usual."""
RECORDS_LOST = "records lost"


class Witnesses:
    """What the cycles' own records say about each period of a core.

    Args:
        rings: The rings of its tasks.
    """

    def __init__(self, rings: list[Ring]) -> None:
        self._rings = rings
        self._cycles: dict[int, list[tuple[int, int, int]]] = {}
        """Start, end and CPU time, by the period in which the cycle began."""
        self._usual = Parts(0.0, 0.0, 0.0, 0.0)

    @property
    def lost(self) -> int:
        """Records of cycles for which there was no room."""
        return sum(ring.lost for ring in self._rings)

    def look(self) -> None:
        """Take in what has happened since the last look."""
        for ring in self._rings:
            for one in ring.drain():
                if not one.kind:
                    cycle = (one.start_ns, one.end_ns, one.cpu_ns)
                    period = one.start_ns // swap.PERIOD
                    self._cycles.setdefault(period, []).append(cycle)

    def settle(self) -> None:
        """Find out what is usual, once all is taken in."""
        parts = [self.parts(period) for period in self._cycles]
        self._usual = Parts(*map(statistics.median, zip(*parts, strict=True)))

    def parts(self, period: int) -> Parts:
        """Return where the time of a period went."""
        begin = period * swap.PERIOD
        end = begin + swap.PERIOD
        near = [one for k in range(-2, 1) for one in self._cycles.get(period + k, [])]
        at, first = begin, 0.0
        used = lost = between = 0.0
        for start, stop, cpu in sorted(near):
            if stop <= at:
                continue
            if at == begin:
                first = max(start - at, 0)
            else:
                between += max(start - at, 0)
            own = max(min(stop, end) - max(start, at), 0)
            used += cpu * own / (stop - start)
            lost += max(stop - start - cpu, 0) * own / (stop - start)
            at = max(at, min(stop, end))
        if at == begin:
            first = end - begin  # nothing ran
        elif len(self._cycles.get(period, [])) < len(self._rings):
            between += end - at  # a task was ready that did not run
        return Parts(used, lost, first, between)

    def explain(self, begin: int, end: int) -> str:
        """Return why a release in an interval was missed; empty if nothing says it.

        Args:
            begin: The release before.
            end: When it was missed.
        """
        least = (swap.PERIOD - sum(self._usual)) / 4
        most, why = least, ""
        for period in range(begin // swap.PERIOD, end // swap.PERIOD + 1):
            above = self.parts(period).above(self._usual)
            for part, reason in zip(above, REASONS, strict=True):
                if part >= most:
                    most, why = part, reason
        return why


class Found:
    """What tasks missed, by their place in the order: instants and numbers."""

    def __init__(self, tasks: int) -> None:
        self.releases = [0] * tasks
        self.misses: list[list[tuple[int, int]]] = [[] for _ in range(tasks)]
        self.lost = 0
        """Records that were lost: what they said is counted nowhere."""

    def unexcused(
        self, late: list[tuple[int, int]]
    ) -> list[list[tuple[int, int, int]]]:
        """Return the misses in whose periods the loop was not late."""
        return [swap.unexcused(one, late, LATE) for one in self.misses]

    def counts(self, late: list[tuple[int, int]]) -> list[dict[str, int]]:
        """Return by place the releases, the missed ones, and those not excused."""
        return [
            {
                "releases": releases,
                "missed": sum(count for _, count in misses),
                "not excused": sum(count for _, _, count in lost),
            }
            for releases, misses, lost in zip(
                self.releases, self.misses, self.unexcused(late), strict=True
            )
        ]


def run_in_c(program: Path, core: int, used: float, seconds: float, to: Found) -> None:
    """Run the processes in C for a block."""
    numbers = (core, rtbench.LEVEL, len(to.releases), swap.PERIOD, round(used * 1e9))
    words = [str(program), *map(str, numbers), str(seconds)]
    done = subprocess.run(words, check=True, capture_output=True)
    lines = iter(done.stdout.splitlines())
    for line in lines:
        place, releases, misses = map(int, line.split())
        to.releases[place] += releases
        for _ in range(misses):
            at, count = map(int, next(lines).split())
            to.misses[place].append((at, count))


def run_tasks(
    subsystem: Subsystem,
    core: int,
    tasks: tuple[str, ...],
    seconds: float,
    *,
    witnesses: Witnesses,
    to: Found,
) -> None:
    """Let tasks that are ON run for a block."""
    traces = [swap.Trace(core, (task,)) for task in tasks]
    reader = swap.Trace(core, ())  # all take what it reads, so they begin together
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        subsystem.wait(0.2)
        records = reader.read()
        for trace in traces:
            trace.take(records)
        witnesses.look()
    to.lost += reader.lost
    for place, trace in enumerate(traces):
        to.releases[place] += trace.released
        to.misses[place] += trace.misses
        trace.close()
    reader.close()


def measure(
    subsystem: Subsystem, folder: Path, tasks: tuple[str, ...], asked: Asked
) -> dict[str, list[dict[str, int]]]:
    """Return what tasks in this order miss, and the processes in C, by place.

    Returns:
        Releases, missed ones, those that no late loop excuses, and why.
    """
    program = rtbench.compile_c("fifo_tasks", folder)
    for task in tasks:
        subsystem.spawn(task, RTPU)
    core = subsystem.clients.call(RTPU, Hello(), AgentInfo).core
    rings = [Ring.attach(one.ring) for one in subsystem.status_all()]
    witnesses = Witnesses(rings)
    ours, theirs = Found(len(tasks)), Found(len(tasks))
    loop: swap.Stalls | None = None
    blocks = max(round(asked.seconds / BLOCK), 1)
    for _ in range(blocks):
        subsystem.reconfig([(task, "on") for task in tasks])
        subsystem.wait(0.5)
        loop = loop or swap.Stalls(folder, core, WAKES, noted=LATE)
        seconds = asked.seconds / blocks
        run_tasks(subsystem, core, tasks, seconds, witnesses=witnesses, to=ours)
        subsystem.reconfig([(task, "off") for task in tasks])
        witnesses.look()
        run_in_c(program, core, asked.used, seconds, theirs)
    assert loop is not None
    _, late = loop.end()
    witnesses.settle()
    counts = ours.counts(late)
    for found, lost in zip(counts, ours.unexcused(late), strict=True):
        found["unexplained"], found[RECORDS_LOST] = 0, ours.lost + witnesses.lost
        for begin, at, count in lost:
            why = witnesses.explain(begin, at) or "unexplained"
            found[why] = found.get(why, 0) + count
    for ring in rings:
        ring.close()
    subsystem.reconfig([(task, "kill") for task in tasks])
    return {"pbonet": counts, "C": theirs.counts(late)}


def report(
    both: list[dict[str, list[dict[str, int]]]], orders: tuple[tuple[str, ...], ...]
) -> None:
    """Print a line for each place in each order."""
    shown = ("releases", "missed", "not excused")
    print(f"{'':17} {'pbonet':>38} {'C':>51}")
    heads = " ".join(f"{one:>12}" for one in (*shown, "unexplained", *shown))
    print(f"{'created':8} {'task':8} {heads}")
    for found, tasks in zip(both, orders, strict=True):
        for place, task in enumerate(tasks):
            ours, theirs = found["pbonet"][place], found["C"][place]
            values = [ours[one] for one in (*shown, "unexplained")]
            values += [theirs[one] for one in shown]
            row = " ".join(f"{one:12}" for one in values)
            why = ", ".join(f"{n} {k}" for k, n in ours.items() if k in REASONS)
            print(f"{place + 1:<8} {task:8} {row}  {why}")


def verdicts(both: list[dict[str, list[dict[str, int]]]]) -> list[str]:
    """Return a line for each goal."""
    ours = [counts for found in both for counts in found["pbonet"]]
    theirs = [counts for found in both for counts in found["C"]]
    shares = [
        sum(one["not excused"] for one in all_of)
        / max(sum(one["releases"] for one in all_of), 1)
        for all_of in (ours, theirs)
    ]
    unexplained = sum(one["unexplained"] for one in ours)
    most_lost = max(one[RECORDS_LOST] for one in ours)
    return [
        rtbench.verdict("not excused, of 10^6", 1e6 * shares[0], 1e6 * shares[1]),
        rtbench.verdict("unexplained", unexplained, 0),
        rtbench.verdict(RECORDS_LOST, most_lost, 0),
    ]


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
    used = asked.load / asked.tasks / swap.RATE
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        sbs = write_files(folder, tasks, used)
        with Embedded("default", libraries=[str(folder)]) as agents:
            agents.start([RTPU])
            with Subsystem(sbs, warned=lambda _text: None, record="off") as subsystem:
                both = [
                    measure(subsystem, folder, order, Asked(used, asked.seconds))
                    for order in (tasks, tasks[::-1])
                ]
    print(rtbench.machine())
    print(
        f"{asked.tasks} tasks of {swap.RATE:g} Hz, {asked.load:.0%} of a core together"
    )
    report(both, (tasks, tasks[::-1]))
    if asked.json:
        asked.json.write_text(json.dumps(both, indent=1), encoding="utf-8")
    rtbench.judge(verdicts(both))


if __name__ == "__main__":
    main()
