"""Run every benchmark in turn, as ``make bench`` does.

python -m benchmarks.run [NAME ...]
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

RUNS = {
    "svar": "svar",
    "ports": "ports",
    "jitter": "jitter",
    "jitter-checks": "jitter --checks --tasks 1 4 16 --blocks 5 --seconds 2",
    "overhead": "overhead",
    "overhead-checks": "overhead --checks --blocks 3 --seconds 1",
    "dispatcher": "overhead --checks --rate 3000 --counts 1 15 --blocks 5 --seconds 1",
    "reserve": "reserve",
    "costs": "costs",
    "aperiodic": "aperiodic",
    "steering": "steering",
    "swap": "swap",
    "transfer": "transfer",
    "simulate": "simulate",
    "ipc": "ipc",
    "tbuf": "tbuf",
    "signals": "signals",
    "hosts": "hosts",
}
"""Module and arguments of each benchmark, by its name."""
ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run those named, or all; return the first exit status that is not 0."""
    wanted = sys.argv[1:] or list(RUNS)
    if unknown := sorted(set(wanted) - set(RUNS)):
        there = ", ".join(RUNS)
        sys.stderr.write(f"no benchmark {', '.join(unknown)}; there are {there}\n")
        return 2
    failed = 0
    for name in wanted:
        print(f"\n== {name}", flush=True)
        module, *arguments = RUNS[name].split()
        command = [sys.executable, "-m", f"benchmarks.{module}", *arguments]
        failed = failed or subprocess.run(command, cwd=ROOT, check=False).returncode
    return failed


if __name__ == "__main__":
    sys.exit(main())
