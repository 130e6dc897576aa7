"""Swaps under way: what tasks that stay lose, and when the new one begins.

A real agent, a real master over zenoh. Two tasks of 1 kHz stay, one of which reads
what the swapped ones write; two controllers of 1 kHz take each other's place again and
again. What the staying tasks missed stands in the dispatcher's own trace; misses that
fall into a stall of a C loop, which does nothing but sleep at the same level on the
same core, are counted apart. Then lists that exchange 2, 10 and 40 tasks.

    python -m benchmarks.swap [--swaps 1000] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import rtbench
from benchmarks.steering import VARIABLE, wait_for_records
from pbonet.master import Subsystem
from pbonet.master.embedded import Embedded
from pbonet.node import _rt
from pbonet.node._ring import Ring
from pbonet.sched.events import Event
from pbonet.xm.messages import AgentInfo, Hello

RATE = 1000.0
PERIOD = round(1e9 / RATE)
SLOW = 50.0
"""Hz of the tasks of a long list."""
PAIRS = (1, 5, 20)
"""So many tasks leave, and as many come: lists of 2, 10 and 40 signals."""
STAY = ("reader", "other")
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


def write_files(folder: Path) -> Path:
    """Write the subsystem; return its ``.sbs`` file."""
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
        "b.sbs": "SUBSYSTEM b\nSVARFILE b.svar\nRTPU bench0\nEOF\n",
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
        self._table = _rt.CoreTable(core, member=False)
        self._slots = {
            i
            for i in self._table.slots()
            if self._table.snapshot(i).task.split("/")[-1] in tasks
        }
        self._next, _, _ = self._table.trace()
        self._now = 0
        self.released = self.lost = 0
        self.misses: list[tuple[int, int]] = []
        """(instant, releases without a cycle of their own)."""

    def look(self) -> None:
        """Take in what was traced since the last look."""
        self._next, lost, records = self._table.trace(self._next)
        self.lost += lost
        for record in records:
            if record.kind == Event.TURN:
                self._now = record.a
            elif record.slot in self._slots and record.kind == Event.RELEASE:
                self.released += 1
            elif record.slot in self._slots and record.kind == Event.MISS:
                self.misses.append((self._now, record.arg))

    def close(self) -> None:
        """Let go of it."""
        self._table.close()


class Stalls:
    """The C loop beside the tasks."""

    def __init__(self, folder: Path, core: int, level: int) -> None:
        program = folder / "stalls"
        source = Path(__file__).with_name("stalls.c")
        subprocess.run(["cc", "-O2", "-o", program, source], check=True)  # noqa: S607 - the compiler is where PATH says
        words = [str(program), str(core), str(level), str(PERIOD)]
        self._process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def end(self) -> tuple[int, list[tuple[int, int]]]:
        """Return the releases of the loop, and its stalls as (due, came)."""
        out, _ = self._process.communicate()
        count, *rest = map(int, out.split())
        return count, list(zip(rest[::2], rest[1::2], strict=True))


def unexcused(trace: Trace, stalls: list[tuple[int, int]]) -> int:
    """Return the misses that fall into no stall of the loop."""
    found = 0
    for at, count in trace.misses:
        begin = at - (count + 1) * PERIOD
        if not any(due <= at and came >= begin for due, came in stalls):
            found += count
    return found


def swaps(subsystem: Subsystem, folder: Path, count: int) -> dict[str, Any]:
    """Swap a and b again and again; return counts and times in periods."""
    for task in ("a", "b", *STAY):
        subsystem.spawn(task)
    subsystem.reconfig([("a", "on"), *((task, "on") for task in STAY)])
    status = {one.task: one for one in subsystem.status_all()}
    rings = {task: Ring.attach(status[task].ring) for task in ("a", "b")}
    core = subsystem.fleet.call("bench0", Hello(), AgentInfo).core
    level = max(os.sched_getparam(status["other"].tid).sched_priority, 0)
    wait_for_records(rings["a"])
    stalls = Stalls(folder, core, level)
    trace = Trace(core, STAY)
    first: list[float] = []
    gap: list[float] = []
    answer: list[float] = []
    old, new = "a", "b"
    try:
        for _ in range(count):
            trace.look()
            begun = time.monotonic_ns()
            subsystem.swap(old, new)
            answer.append(time.monotonic_ns() - begun)
            begins = wait_for_records(rings[new])[0].start_ns
            last = wait_for_records(rings[old])[-1].start_ns
            first.append(begins - begun)
            gap.append(begins - last)
            old, new = new, old
        trace.look()
    finally:
        releases, late = stalls.end()
        trace.close()
        for ring in rings.values():
            ring.close()
    subsystem.reconfig([(task, "off") for task in (old, *STAY)])
    return {
        "releases": trace.released,
        "records lost": trace.lost,
        "missed": sum(count for _, count in trace.misses),
        "missed, loop was not late": unexcused(trace, late),
        "releases of the loop": releases,
        "stalls of the loop": len(late),
        "command to first cycle": [ns / PERIOD for ns in first],
        "last cycle to first cycle": [ns / PERIOD for ns in gap],
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


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Swaps under way.")
    parser.add_argument("--swaps", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        sbs = write_files(folder)
        with Embedded("default") as agents:
            agents.start(["bench0"])
            with Subsystem(sbs, warned=lambda _text: None, record="off") as subsystem:
                found = swaps(subsystem, folder, args.swaps)
                lengths = lists(subsystem, args.rounds)
    print(rtbench.machine())
    print(f"{args.swaps} swaps, tasks of {RATE:.0f} Hz; two that stay:")
    for key, value in found.items():
        if isinstance(value, int):
            print(f"  {key:28} {value}")
    print(f"periods of {PERIOD / 1e6:g} ms {'p50':>20} {'p90':>8} {'max':>8}")
    for key, value in found.items():
        if not isinstance(value, int):
            p50, p90 = np.quantile(value, [0.5, 0.9])
            print(f"  {key:28} {p50:8.2f} {p90:8.2f} {max(value):8.2f}")
    print(f"signals in a list, ms {'p50':>16} {'max':>8}")
    for count, times in lengths.items():
        print(f"  {count:28} {np.median(times):8.2f} {max(times):8.2f}")
    if args.json:
        text = json.dumps({**found, "lists": lengths}, indent=1)
        args.json.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
