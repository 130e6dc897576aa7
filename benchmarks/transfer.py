"""Share of a task's CPU time that goes into transfers: the thesis's Table 1, today.

Runs the PUMA 560 example and prints, per task, the mean time of a copy-in and a
copy-out, and their share of the mean cycle, beside what Table 1 of section 6.6.1 gives
for an MC68030.

    python -m benchmarks.transfer [--seconds 10] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

from benchmarks import rtbench
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded

JOB = Path(__file__).resolve().parents[1] / "examples" / "puma" / "puma.job"
TABLE_1 = {"puma_pidg": 14.0, "grav_comp": 7.8, "qrdiff": 43.0, "jttrace": 24.0}
"""Per cent of transfer time on the MC68030; `qrdiff` is the thesis's diff, and
`jttrace` stands for its jtball."""


def measure(seconds: float) -> dict[str, dict[str, float]]:
    """Return each task's mean transfer times and cycle in us, and the share in %."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PBONET_RUN_DIR"] = str(Path(folder) / "run")
        subsystem = Subsystem(JOB)
        with Embedded("default") as agents:
            agents.start([rtpu.name for rtpu in subsystem.sbs.rtpus])
            with subsystem:
                subsystem.start()
                time.sleep(seconds)
                return {
                    one.task: {
                        "in": one.transfer_in * 1e6,
                        "out": one.transfer_out * 1e6,
                        "cycle": one.tot_c / one.cycle * 1e6,
                        "share": 100
                        * (one.transfer_in + one.transfer_out)
                        * one.cycle
                        / one.tot_c,
                    }
                    for one in subsystem.status_all()
                }


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Transfers of the PUMA example.")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = measure(args.seconds)
    print(rtbench.machine())
    print(
        f"{'task':12} {'in us':>8} {'out us':>8} {'cycle us':>9} {'%':>6} {'1994 %':>7}"
    )
    for task, got in found.items():
        print(
            f"{task:12} {got['in']:8.2f} {got['out']:8.2f} {got['cycle']:9.1f} "
            f"{got['share']:6.1f} {TABLE_1[task]:7.1f}"
        )
    if args.json:
        args.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
