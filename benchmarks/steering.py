"""From a command to its effect: spawn to OFF, on to the first cycle, off to the last.

A real agent, a real master over zenoh, one task of 1 kHz made of the library's `sine`.
When a cycle began is read from the task's own ring, on the clock that timed the
command. Status 3: a goal was missed. The goals are our own: an operator notices no
delay, and about twice what was measured; a spawn is to take 25 ms.

    python -m benchmarks.steering [--rounds 30] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import rtbench
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.node.ring._ring import Record, Ring

RATE = 1000.0
GOALS = {
    "spawn: command to OFF": 25.0,
    "on: command to first cycle": 10.0,
    "off: command to last cycle": 10.0,
    "kill: command to NOT-CREATED": 50.0,
}
"""Milliseconds that the median may have."""
SBS = """\
SUBSYSTEM steering
SVARFILE  steering.svar
RTPU      bench0
EOF
"""
VARIABLE = """\
NAME  {name}
TYPE  {kind}
DESC  of the benchmark
UNITS {units}
NELEM {nelem}
"""
SVAR = (
    VARIABLE.format(name="NDOF", kind="int", units="none", nelem=1)
    + "INIT 6\n\n"
    + VARIABLE.format(name="Y", kind="double", units="rad", nelem=6)
    + "\n"
    + VARIABLE.format(name="Y^", kind="double", units="rad/s", nelem=6)
    + "\nEOF\n"
)


def wait_for_records(ring: Ring, seconds: float = 5.0) -> list[Record]:
    """Return what stands in the ring as soon as something does."""
    end = time.monotonic() + seconds
    while not (records := [one for one in ring.drain() if not one.kind]):
        if time.monotonic() > end:
            raise TimeoutError(f"no cycle within {seconds} s")
    return records


def one_round(subsystem: Subsystem) -> dict[str, float]:
    """Create, turn on, turn off and destroy one task; return the times in ms."""
    now = time.monotonic_ns
    got: dict[str, float] = {}
    begun = now()
    status = subsystem.spawn("sine", hz=RATE)
    got["spawn: command to OFF"] = now() - begun
    ring = Ring.attach(status.ring)
    begun = now()
    subsystem.control("sine", "on")
    got["on: command to answer"] = now() - begun
    got["on: command to first cycle"] = wait_for_records(ring)[0].start_ns - begun
    wait_for_records(ring)
    begun = now()
    subsystem.control("sine", "off")
    got["off: command to answer"] = now() - begun
    last = [one.end_ns for one in ring.drain() if not one.kind]
    if last:
        got["off: command to last cycle"] = max(0, last[-1] - begun)
    ring.close()
    begun = now()
    subsystem.control("sine", "kill")
    got["kill: command to NOT-CREATED"] = now() - begun
    return {name: ns / 1e6 for name, ns in got.items()}


def measure(rounds: int) -> dict[str, list[float]]:
    """Return the times of all rounds in ms; the first round is not counted."""
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PBONET_RUN_DIR"] = str(Path(folder) / "run")
        for name, text in (("steering.sbs", SBS), ("steering.svar", SVAR)):
            (Path(folder) / name).write_text(text, encoding="utf-8")
        with Embedded("default") as agents:
            agents.start(["bench0"])
            quiet = Subsystem(
                Path(folder) / "steering.sbs", warned=lambda _text: None, record="off"
            )
            with quiet as subsystem:
                one_round(subsystem)
                for _ in range(rounds):
                    for name, ms in one_round(subsystem).items():
                        found.setdefault(name, []).append(ms)
    return found


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="From commands to effects.")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = measure(args.rounds)
    print(rtbench.machine())
    print(f"one task of {RATE:.0f} Hz, {args.rounds} rounds, milliseconds")
    print(f"{'':30} {'p50':>8} {'p90':>8} {'max':>8}")
    for name, values in found.items():
        p50, p90 = np.quantile(values, [0.5, 0.9])
        print(f"{name:30} {p50:8.2f} {p90:8.2f} {max(values):8.2f}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    rtbench.judge(
        rtbench.verdict(f"{name}, ms, median", float(np.median(found[name])), most)
        for name, most in GOALS.items()
    )


if __name__ == "__main__":
    main()
