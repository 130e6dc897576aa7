"""Swaps under way: what tasks that stay lose, and when the new one begins.

A real agent, a real master over zenoh. Two tasks of 1 kHz stay, one of which reads
what the swapped ones write; two controllers of 1 kHz take each other's place again and
again. What the staying tasks missed stands in the dispatcher's own trace. Beside them
runs a C loop of 1 kHz that does nothing but sleep, on the same core and above the
dispatcher, so that nothing of pbonet can make it late. It wakes up in the middle
between two releases. There it takes nothing from the tasks, which are done in a quarter
of a period; and whatever keeps them from being done by the end of the period makes it
late, by a quarter at least. So a miss is excused when the loop was that late in the
periods that the miss is about. Excused misses are counted apart, and of each other one
is said how late the dispatcher and the loop were. Then lists that exchange 2, 10 and 40
tasks.

With ``--rtpus 2`` the two controllers are on two RTPUs; of the tasks that stay one is
on each. These have a core each, with a loop beside it, where the machine has three or
more; on one with two cores both are on the second. Before the swaps everything runs
as long without any, for comparison. Ends with status 3 when a goal is missed.

    python -m benchmarks.swap [--swaps 1000] [--rtpus 2] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import rtbench
from benchmarks.steering import VARIABLE, wait_for_records
from pbonet.analysis.schedule.events import Event
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.node import rt
from pbonet.node.ring._ring import Ring
from pbonet.xm.net.messages import AgentInfo, Hello

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.analysis.schedule import Decision

RATE = 1000.0
PERIOD = round(1e9 / RATE)
SWAP_TIME = 0.06
"""Seconds without swaps, before, for each swap."""
SLOW = 50.0
"""Hz of the tasks of a long list."""
PAIRS = (1, 5, 20)
"""So many tasks leave, and as many come: lists of 2, 10 and 40 signals."""
STAY: tuple[str, ...] = ("reader", "other")
"""On the first and on the last RTPU."""
ABOVE = rt.DISPATCHER_LEVEL + 1
"""The level of the C loop."""
NOTED = PERIOD // 100
"""So many nanoseconds late a turn or the loop must be to be looked at at all."""
LATE = PERIOD // 4
"""So many nanoseconds late the loop must have been to excuse a miss."""
LOST = "missed, loop was not late"
EXCUSED = "missed, loop was late, too"
GAP = "last cycle to first cycle"
RMOD = """\
MODULE    {module}
DESC      of the benchmark
{aliases}
INCONST   NDOF
OUTCONST  none
INVAR     {invar}
OUTVAR    {outvar}
TASKTYPE  periodic
FREQ      {rate:g}
{local}
EOF
"""


def wave(number: int, rate: float) -> str:
    """Return the RMOD of a task that writes the variables of a number."""
    aliases = f"SVARALIAS Y=Y{number}\nSVARALIAS Y^=V{number}"
    local = "LOCAL\nAMPLITUDE 1\nFREQ 1"
    return RMOD.format(
        module="sine", aliases=aliases, invar="none", outvar="Y Y^", rate=rate,
        local=local,
    )  # fmt: skip


def write_files(folder: Path, rtpus: list[str]) -> Path:
    """Write the subsystem; return its ``.sbs`` file."""
    lines = "".join(f"RTPU {rtpu}\n" for rtpu in rtpus)
    numbers = range(max(PAIRS) + 2)
    variables = [VARIABLE.format(name="NDOF", kind="int", units="none", nelem=1)]
    variables[0] += "INIT 6\n"
    names = [f"{letter}{number}" for number in numbers for letter in "YV"] + ["D"]
    variables += [
        VARIABLE.format(name=name, kind="double", units="any", nelem=6)
        for name in names
    ]
    aliases = "SVARALIAS Z=Y0\nSVARALIAS Z^=D"
    files = {
        "b.svar": "\n".join(variables) + "\nEOF\n",
        "b.sbs": f"SUBSYSTEM b\nSVARFILE b.svar\n{lines}EOF\n",
        "a.rmod": wave(0, RATE),
        "b.rmod": wave(0, RATE),
        "other.rmod": wave(1, RATE),
        "reader.rmod": RMOD.format(
            module="diff", aliases=aliases, invar="Z", outvar="Z^", rate=RATE, local=""
        ),
    }
    for number in range(max(PAIRS)):
        for side in "st":
            files[f"{side}{number}.rmod"] = wave(number + 2, SLOW)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "b.sbs"


class Trace:
    """What the dispatcher's trace says of some tasks' releases.

    Args:
        core: Whose.
        tasks: Their names.
    """

    def __init__(self, core: int, tasks: tuple[str, ...]) -> None:
        self._table = rt.CoreTable(core, member=False)
        self._slots = {
            i
            for i in self._table.slots()
            if self._table.snapshot(i).task.split("/")[-1] in tasks
        }
        self._next, _, _ = self._table.trace()
        self._now = 0
        self.release = 0
        """The last."""
        self.released = self.lost = 0
        self.misses: list[tuple[int, int]] = []
        """(instant, releases without a cycle of their own)."""
        self.turns: list[tuple[int, int]] = []
        """Of turns that came late: (the release that they were for, instant)."""

    def look(self) -> None:
        """Take in what was traced since the last look."""
        self.take(self.read())

    def read(self) -> list[Decision]:
        """Return what was traced since the last look, of all tasks."""
        self._next, lost, records = self._table.trace(self._next)
        self.lost += lost
        return records

    def take(self, records: list[Decision]) -> None:
        """Take in what was traced."""
        for record in records:
            if record.kind == Event.TURN:
                self._now = record.a
            elif record.slot in self._slots and record.kind == Event.RELEASE:
                self.released += 1
                self.release = record.a
                if self._now - record.a > NOTED:
                    self.turns.append((record.a, self._now))
            elif record.slot in self._slots and record.kind == Event.MISS:
                self.misses.append((self._now, record.arg))
            elif record.slot in self._slots and record.kind == Event.DONE:
                self.released += record.arg  # of a lone task, by itself

    def close(self) -> None:
        """Let go of it."""
        self._table.close()


def phase(core: int, tasks: tuple[str, ...], period: int) -> int:
    """Return where in a period the tasks of a core are released, in nanoseconds."""
    trace = Trace(core, tasks)
    while not trace.release:
        time.sleep(0.01)
        trace.look()
    trace.close()
    return trace.release % period


class Stalls:
    """The C loop beside the tasks, which waits in the middle between two releases.

    Args:
        folder: For its program.
        core: Where it runs.
        wakes: So often it wakes up in a period, at equal distances.
        tasks: Tasks on that core; `STAY` by default.
        period: Theirs, in nanoseconds; `PERIOD` by default.
        noted: So many nanoseconds late a wake-up must be to be noted.

    Raises:
        PermissionError: It could not be had above the dispatcher.
    """

    def __init__(
        self,
        folder: Path,
        core: int,
        wakes: int = 1,
        *,
        tasks: tuple[str, ...] = (),
        period: int = 0,
        noted: int = NOTED,
    ) -> None:
        period = period or PERIOD
        program = folder / f"stalls{core}"
        source = Path(__file__).with_name("stalls.c")
        subprocess.run(["cc", "-O2", "-o", program, source], check=True)  # noqa: S607 - the compiler is where PATH says
        middle = phase(core, tasks or STAY, period) + period // wakes // 2
        period //= wakes
        words = [str(program), *map(str, (core, ABOVE, period, middle, noted))]
        self._process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        if not (self._process.stdout and self._process.stdout.readline()):
            msg = f"the C loop needs SCHED_FIFO {ABOVE}, above the dispatcher"
            raise PermissionError(msg)

    def end(self) -> tuple[int, list[tuple[int, int]]]:
        """Return the wake-ups of the loop, and the late ones as (due, came)."""
        out, _ = self._process.communicate()
        count, *rest = map(int, out.split())
        return count, list(zip(rest[::2], rest[1::2], strict=True))


class Watched:
    """What the tasks that stay miss from here on, and how the C loops fare beside.

    Args:
        subsystem: Whose tasks.
        folder: For the loop's program.
        rtpus: Where they are.
    """

    def __init__(self, subsystem: Subsystem, folder: Path, rtpus: list[str]) -> None:
        call = subsystem.clients.call
        cores = {call(rtpu, Hello(), AgentInfo).core for rtpu in rtpus}
        loops = [(core, Stalls(folder, core)) for core in cores]
        self._cores = [(loop, Trace(core, STAY)) for core, loop in loops]

    def look(self) -> None:
        """Take in what was traced since the last look."""
        for _, trace in self._cores:
            trace.look()

    def end(self) -> dict[str, int]:
        """Return the counts, of all cores together; print what no loop excuses."""
        counts: Counter[str] = Counter()
        for loop, trace in self._cores:
            trace.look()
            wake_ups, late = loop.end()
            trace.close()
            missed = sum(count for _, count in trace.misses)
            lost = unexcused(trace.misses, late)
            for begin, at, _ in lost:
                turn, woken = (
                    most_late(some, begin, at) / PERIOD for some in (trace.turns, late)
                )
                print(
                    f"missed: the dispatcher {turn:.2f} periods late, loop {woken:.2f}"
                )
            counts.update({
                "releases": trace.released,
                "records lost": trace.lost,
                "missed": missed,
                EXCUSED: missed - sum(count for _, _, count in lost),
                LOST: sum(count for _, _, count in lost),
                "wake-ups of the loop": wake_ups,
                "late wake-ups of the loop": sum(c - due >= LATE for due, c in late),
            })
        return dict(counts)


def most_late(late: list[tuple[int, int]], begin: int, end: int) -> int:
    """Return by how much one was late at most within an interval, in nanoseconds."""
    return max((c - due for due, c in late if due <= end and c >= begin), default=0)


def unexcused(
    misses: list[tuple[int, int]], late: list[tuple[int, int]], least: int = LATE
) -> list[tuple[int, int, int]]:
    """Return misses in whose periods the loop was not late: begin, end, releases."""
    about = [(at - (count + 1) * PERIOD, at, count) for at, count in misses]
    return [one for one in about if most_late(late, *one[:2]) < least]


def start(subsystem: Subsystem, rtpus: list[str]) -> None:
    """Have a and the tasks that stay run, and b stand by on the last RTPU."""
    for task, rtpu in (("a", rtpus[0]), *zip(STAY, (rtpus[0], rtpus[-1]), strict=True)):
        subsystem.spawn(task, rtpu)
    subsystem.spawn("b", rtpus[-1])
    subsystem.reconfig([("a", "on"), *((task, "on") for task in STAY)])
    subsystem.wait(0.5)


def undisturbed(
    subsystem: Subsystem, watched: Watched, seconds: float
) -> tuple[dict[str, int], list[float]]:
    """Return the counts of a time without swaps.

    Returns:
        The counts, and behind how much of a period the cycles of the tasks that stay
        are done.
    """
    rings = [Ring.attach(subsystem.status(task).ring) for task in STAY]
    done: list[float] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        subsystem.wait(0.2)
        watched.look()
        records = [one for ring in rings for one in ring.drain() if not one.kind]
        done += [(one.end_ns - one.release_ns) / PERIOD for one in records]
    for ring in rings:
        ring.close()
    return watched.end(), done


def swaps(
    subsystem: Subsystem, make: Callable[[], Watched], count: int
) -> dict[str, Any]:
    """Swap a and b again and again; return counts and times in periods."""
    status = {one.task: one for one in subsystem.status_all()}
    rings = {task: Ring.attach(status[task].ring) for task in ("a", "b")}
    wait_for_records(rings["a"])
    watched = make()
    first: list[float] = []
    gap: list[float] = []
    answer: list[float] = []
    old, new = "a", "b"
    try:
        for _ in range(count):
            watched.look()
            begun = time.monotonic_ns()
            subsystem.swap(old, new)
            answer.append(time.monotonic_ns() - begun)
            begins = wait_for_records(rings[new])[0].start_ns
            last = wait_for_records(rings[old])[-1].start_ns
            first.append(begins - begun)
            gap.append(begins - last)
            old, new = new, old
    finally:
        counts = watched.end()
        for ring in rings.values():
            ring.close()
    subsystem.reconfig([(task, "off") for task in (old, *STAY)])
    return {
        **counts,
        "command to first cycle": [ns / PERIOD for ns in first],
        GAP: [ns / PERIOD for ns in gap],
        "command to answer": [ns / PERIOD for ns in answer],
    }


def lists(subsystem: Subsystem, rounds: int) -> dict[int, list[float]]:
    """Return the times in ms of lists that exchange tasks, by number of signals."""
    found: dict[int, list[float]] = {}
    made = 0
    for pairs in PAIRS:
        for number in range(made, pairs):
            subsystem.spawn(f"s{number}")
            subsystem.spawn(f"t{number}")
            subsystem.control(f"s{number}", "on")
        made = pairs
        sides = [[f"{side}{number}" for number in range(pairs)] for side in "st"]
        for _ in range(2 * rounds):
            begun = time.monotonic_ns()
            subsystem.swap(*sides)
            found.setdefault(2 * pairs, []).append((time.monotonic_ns() - begun) / 1e6)
            sides.reverse()
    return found


def judge(found: dict[str, Any]) -> list[str]:
    """Return a line for each goal."""
    gap = float(np.median(np.asarray(found[GAP], np.float64)))
    goals = {
        "cycles that staying tasks lose, but for stalls, at most 0": (found[LOST], 0),
        f"periods from {GAP}, median, below 2": (gap, 2 - 1e-9),
    }
    return [
        f"- {text}: {got:.3g}, **{'met' if got <= most else 'NOT met'}**"
        for text, (got, most) in goals.items()
    ]


def report(
    quiet: dict[str, int], found: dict[str, Any], period: float = PERIOD
) -> list[str]:
    """Return what was found, as lines; times are in periods of so many ns."""
    lines = [f"  {'':28} {'with swaps':>12} {'without':>12}"]
    lines += [f"  {key:28} {found[key]:12} {quiet[key]:12}" for key in quiet]
    lines.append(f"periods of {period / 1e6:g} ms {'p50':>20} {'p90':>8} {'max':>8}")
    for key in [key for key in found if key not in quiet]:
        values = np.asarray(found[key], np.float64)
        p50, p90 = (float(np.quantile(values, share)) for share in (0.5, 0.9))
        lines.append(f"  {key:28} {p50:8.2f} {p90:8.2f} {max(found[key]):8.2f}")
    return lines


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Swaps under way.")
    parser.add_argument("--swaps", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--rtpus", type=int, default=1, choices=[1, 2])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rtpus = [f"bench{number}" for number in range(args.rtpus)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        sbs = write_files(folder, rtpus)
        with Embedded("default") as agents:
            cores = agents.start(rtpus)
            with Subsystem(sbs, warned=lambda _text: None, record="off") as subsystem:
                start(subsystem, rtpus)
                watch = partial(Watched, subsystem, folder, rtpus)
                quiet, done = undisturbed(subsystem, watch(), args.swaps * SWAP_TIME)
                found = swaps(subsystem, watch, args.swaps)
                lengths = lists(subsystem, args.rounds) if args.rtpus == 1 else {}
    print(rtbench.machine())
    where = " and ".join(map(str, sorted(set(cores.values()))))
    print(f"{args.swaps} swaps, {args.rtpus} RTPUs on core {where}, {RATE:.0f} Hz;")
    print("two tasks stay:")
    print("\n".join(report(quiet, found)))
    p50, p99 = np.quantile(done, [0.5, 0.99])
    print(f"without swaps, release to end of a cycle: p50 {p50:.2f}, p99 {p99:.2f}")
    if lengths:
        print(f"signals in a list, ms {'p50':>16} {'max':>8}")
    for count, times in lengths.items():
        print(f"  {count:28} {np.median(times):8.2f} {max(times):8.2f}")
    goals = judge(found)
    if args.json:
        whole = {**found, "without swaps": quiet, "lists": lengths}
        args.json.write_text(json.dumps(whole, indent=1), encoding="utf-8")
    rtbench.judge(goals)


if __name__ == "__main__":
    main()
