"""Signals and events: what sending costs, how fast they arrive, whether all are there.

A real agent, a real master over zenoh, and tasks that send. The cost of a call is
measured within the cycle, in CPU time of the task. When a signal was sent is read from
the task's own ring, on the clock that timed the wait. Ends with status 3 when a signal
is not accounted for, by the waiter or by the counts that `status` shows.

    python -m benchmarks.signals [--rounds 50] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import rtbench
from pbonet.errors import NoAnswerError
from pbonet.master import Subsystem
from pbonet.master.console.follow_events import Follower
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.master.subsystem.event_filter import EventFilter
from pbonet.node.ring._ring import Ring

TASKS = 8
TOTAL = 5000
"""Signals of each task in the flood."""
BURST = 100
RATE = 50.0
SLOW = 20.0
MODULE = '''
"""Sends signals and times the calls."""

import time
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, UserSignal, Vector, param


class Amount(Params):
    """How many."""

    total: A[int, param("none", "signals in all", ge=0)]
    burst: A[int, param("none", "signals in a cycle", ge=1)]


class Sender(PortBasedObject[Amount]):
    """Sends until `total` were sent."""

    SENT = UserSignal(0, "one more")

    y: A[Vector, OutVar("Y", "2", "none", "signals sent; CPU nanoseconds of all")]

    def on(self) -> None:
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        count = min(self.params.burst, self.params.total - int(self.y[0]))
        begin = time.thread_time_ns()
        for _ in range(count):
            self.task.signal(self.SENT)
        self.y[1] += time.thread_time_ns() - begin
        self.y[0] += count
'''
RMOD = """\
MODULE    sender
DESC      sends
SVARALIAS Y={out}
INCONST   none
OUTCONST  none
INVAR     none
OUTVAR    Y
TASKTYPE  periodic
FREQ      {freq:g}
LOCAL
total {total}
burst {burst}
EOF
"""
SBS = "SUBSYSTEM signals\nSVARFILE signals.svar\nRTPU bench0\nEOF\n"
VARIABLE = "NAME {}\nTYPE double\nDESC y\nUNITS none\nNELEM 2\n\n"


def prepare(folder: Path, rounds: int) -> None:
    """Write the files of the subsystem."""
    names = [f"Y{n}" for n in range(TASKS + 1)]
    table = "".join(map(VARIABLE.format, names)) + "EOF\n"
    files = {"signals.sbs": SBS, "signals.svar": table, "sender.py": MODULE}
    for n in range(TASKS):
        text = RMOD.format(out=f"Y{n}", freq=RATE, total=TOTAL, burst=BURST)
        files[f"f{n}.rmod"] = text
    slow = RMOD.format(out=f"Y{TASKS}", freq=SLOW, total=rounds, burst=1)
    files["slow.rmod"] = slow
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def delays(subsystem: Subsystem, rounds: int) -> list[float]:
    """Return the times from the begin of a sending cycle to the waiter, in ms."""
    ring = Ring.attach(subsystem.spawn("slow").ring)
    subsystem.control("slow", "on")
    taken: list[int] = []
    while len(taken) < rounds:
        sent = subsystem.sigwait(["SENT"], task=["slow"], timeout=10.0)
        taken += [time.monotonic_ns()] * sent.count
    subsystem.control("slow", "off")
    begun = [one.start_ns for one in ring.drain() if not one.kind]
    ring.close()
    return [(end - start) / 1e6 for start, end in zip(begun, taken, strict=False)]


def flood(subsystem: Subsystem) -> dict[str, float]:
    """Have all tasks send at once; return what came of it."""
    names = [f"f{n}" for n in range(TASKS)]
    for name in names:
        subsystem.spawn(name)
    follower = Follower(subsystem, EventFilter())
    follower.take()
    begin = time.monotonic()
    subsystem.reconfig([(name, "on") for name in names])
    taken = events = 0
    with contextlib.suppress(NoAnswerError):  # what has not come by then is lost
        while taken < TASKS * TOTAL:
            taken += subsystem.sigwait(["SENT"], task=names, timeout=10.0).count
            events += len(follower.take())
    seconds = time.monotonic() - begin
    values = [one.values for one in subsystem.display([f"Y{n}" for n in range(TASKS)])]
    spent = sum(float(one[1]) for one in values)
    status = [subsystem.status(name) for name in names]
    return {
        "signals sent": sum(float(one[0]) for one in values),
        "signals accounted for": taken,
        "signals in status": sum(one.signals["SENT"] for one in status),
        "seconds": seconds,
        "signals per second": taken / seconds,
        "events per second": events / seconds,
        "CPU time of a call (us)": spent / (TASKS * TOTAL) / 1e3,
    }


def measure(rounds: int) -> tuple[list[float], dict[str, float]]:
    """Return the delays in ms, and what the flood gave."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        prepare(folder, rounds)
        with Embedded("default", libraries=[str(folder)]) as agents:
            agents.start(["bench0"])
            path = folder / "signals.sbs"
            with Subsystem(
                path,
                libraries=[str(folder)],
                warned=lambda _text: None,
                record="off",
            ) as subsystem:
                return delays(subsystem, rounds), flood(subsystem)


def goal(found: dict[str, float]) -> str:
    """Return the goal's line: what was asked, what was measured."""
    sent = found["signals sent"]
    got = (found["signals accounted for"], found["signals in status"])
    met = sent == TASKS * TOTAL and got == (sent, sent)
    amiss = max(abs(one - TASKS * TOTAL) for one in (sent, *got))
    return f"- no signal lost or told twice: {amiss:.0f}, {'met' if met else 'NOT met'}"


def main() -> None:
    """Measure and report; status 3 when the goal is missed."""
    parser = argparse.ArgumentParser(description="Signals and events.")
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    late, found = measure(args.rounds)
    print(rtbench.machine())
    p50, p90 = np.quantile(late, [0.5, 0.9])
    print(f"from the begin of the sending cycle to the waiter, {len(late)} signals, ms")
    print(f"p50 {p50:.2f}  p90 {p90:.2f}  max {max(late):.2f}")
    print(f"{TASKS} tasks of {RATE:g} Hz, {BURST} signals a cycle")
    for what, value in found.items():
        print(f"{what:26} {value:12.2f}")
    line = goal(found)
    print(line)
    if args.json:
        data = {"delays_ms": late, **found}
        args.json.write_text(json.dumps(data, indent=1), encoding="utf-8")
    if "NOT met" in line:
        sys.exit(3)  # see run.py


if __name__ == "__main__":
    main()
