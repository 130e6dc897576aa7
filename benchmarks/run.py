"""Run every benchmark in turn, as ``make bench`` does.

With ``--quick`` each does the least that it can: the numbers mean nothing then, but
that every benchmark still runs is seen in some minutes. At the end stands what each
took, and whether it met its goals; a benchmark that ran and missed one ends with status
3. So does this: 3 when goals were missed, which in a quick run means nothing, and 1
when a benchmark failed.

python -m benchmarks.run [--quick] [NAME ...]
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from pathlib import Path

RUNS = {
    "svar": "svar",
    "ports": "ports",
    "library": "library",
    "mavlink": "mavlink",
    "jitter": "jitter",
    "jitter-checks": "jitter --checks --tasks 1 4 16 --blocks 5 --seconds 2",
    "overhead": "overhead",
    "overhead-checks": "overhead --checks --blocks 3 --seconds 1",
    "dispatcher": "overhead --checks --rate 3000 --counts 1 15 --blocks 5 --seconds 1",
    "reserve": "reserve",
    "costs": "costs",
    "aperiodic": "aperiodic",
    "startup": "startup",
    "memory": "memory",
    "steering": "steering",
    "unreachable": "unreachable",
    "swap": "swap",
    "swap-across": "swap --rtpus 2",
    "swap-hosts": "swap_hosts",
    "fallback": "fallback",
    "transfer": "transfer",
    "simulate": "simulate",
    "allocate": "allocate",
    "ipc": "ipc",
    "tbuf": "tbuf",
    "tbuf-tasks": "tbuf_tasks",
    "ros2": "ros2",
    "signals": "signals",
    "hosts": "hosts",
    "faults": "faults",
    "combine": "combine",
    "cmodules": "cmodules",
    "record": "record",
    "kills": "kills",
    "soak": "soak",
    "siblings": "siblings",
    "equal-tasks": "equal_tasks",
    "devices": "devices",
    "spp": "spp",
    "mppi": "mppi",
    "web": "web",
    "metrics": "metrics",
    "rivals": "rivals",
    "scale": "scale",
}
"""Module and arguments of each benchmark, by its name."""
QUICK = {
    "svar": "--rounds 2",
    "ports": "--rounds 1",
    "library": "--cycles 100",
    "mavlink": "--cycles 100",
    "jitter": "--blocks 1 --seconds 0.5",
    "jitter-checks": "--tasks 1 4 --blocks 1 --seconds 0.3",
    "overhead": "--counts 1 4 --seconds 0.3",
    "overhead-checks": "--counts 1 4 --blocks 1 --seconds 0.3",
    "dispatcher": "--blocks 1 --seconds 0.3",
    "reserve": "--blocks 1 --cycles 10",
    "costs": "--blocks 1",
    "aperiodic": "--seconds 1",
    "startup": "--rounds 2",
    "kills": "--rounds 2",
    "soak": "--minutes 0.1",
    "siblings": "--seconds 0.5",
    "equal-tasks": "--seconds 1",
    "devices": "--calls 100",
    "spp": "--calls 100",
    "mppi": "--updates 3 --rollouts 64",
    "web": "--quick",
    "metrics": "--quick",
    "rivals": "--rounds 1 --seconds 0.3",
    "scale": "--quick",
    "steering": "--rounds 2",
    "unreachable": "--rounds 1",
    "swap": "--swaps 20 --rounds 1",
    "swap-across": "--swaps 20",
    "swap-hosts": "--swaps 20",
    "fallback": "--deaths 3",
    "transfer": "--seconds 1",
    "simulate": "--seconds 2",
    "allocate": "--sets 1 --seconds 2",
    "ipc": "--rounds 3",
    "tbuf": "--rounds 2 --seconds 1",
    "tbuf-tasks": "--rounds 1 --seconds 1",
    "ros2": "--rounds 1 --seconds 1",
    "signals": "--rounds 3",
    "combine": "--blocks 1 --seconds 1",
    "cmodules": "--blocks 1 --seconds 0.5 --swaps 4",
    "hosts": "--seconds 1 --times 1",
    "faults": "--quick",
    "record": "--blocks 1 --seconds 0.5 --megabytes 20",
}
"""Arguments behind those, which take their place, for a quick run."""
NO_GOAL = {
    *("ports", "aperiodic"),
    "transfer",
}
"""Modules that show how something is, and judge nothing."""
MISSED = 3
ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run those named, or all; return 0 when every one of them did what it must."""
    wanted = [word for word in sys.argv[1:] if word != "--quick"] or list(RUNS)
    quick = "--quick" in sys.argv[1:]
    if unknown := sorted(set(wanted) - set(RUNS)):
        there = ", ".join(RUNS)
        sys.stderr.write(f"no benchmark {', '.join(unknown)}; there are {there}\n")
        return 2
    results: dict[str, tuple[float, int]] = {}
    with contextlib.suppress(KeyboardInterrupt):
        for name in wanted:
            print(f"\n== {name}", flush=True)
            begun = time.monotonic()
            status = run(name, quick=quick)
            results[name] = time.monotonic() - begun, status
    lines, status = summary(wanted, results, quick=quick)
    print("", *lines, sep="\n")
    return status


def run(name: str, *, quick: bool) -> int:
    """Run one; return its status."""
    module, *arguments = RUNS[name].split()
    arguments += QUICK.get(name, "").split() if quick else []
    command = [sys.executable, "-m", f"benchmarks.{module}", *arguments]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


def summary(
    wanted: list[str], results: dict[str, tuple[float, int]], *, quick: bool
) -> tuple[list[str], int]:
    """Return what is printed at the end, and the status of all.

    Args:
        wanted: The benchmarks that were to run.
        results: Of those that did, the seconds and the status.
        quick: Missed goals mean nothing.
    """
    lines: list[str] = []
    for name in wanted:
        seconds, status = results.get(name, (0.0, -1))
        if name not in results:
            told = "not run"
        elif status == MISSED:
            told = "goal missed" + ", which says nothing here" * quick
        elif status:
            told = f"FAILED with status {status}"
        else:
            shown = RUNS[name].split()[0] in NO_GOAL
            told = "shown, it has no goal" if shown else "good"
        lines.append(f"{name:<18}{seconds:>7.0f} s  {told}")
    each = [status for _, status in results.values()]
    missed = each.count(MISSED)
    failed = len(wanted) - each.count(0) - missed
    lines.append(
        f"{len(wanted)} benchmarks: {each.count(0)} good, {missed} missed a goal, "
        f"{failed} failed or not run"
    )
    return lines, 1 if failed else MISSED if missed and not quick else 0


if __name__ == "__main__":
    sys.exit(main())
