"""Run every benchmark in turn, as ``make bench`` does.

python -m benchmarks.run [NAME ...]
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

NAMES = (
    "svar",
    "ports",
    "jitter",
    "overhead",
    "steering",
    "transfer",
    "simulate",
    "ipc",
)
ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run those named, or all; return the first exit status that is not 0."""
    wanted = sys.argv[1:] or NAMES
    if unknown := sorted(set(wanted) - set(NAMES)):
        sys.stderr.write(f"no benchmark {', '.join(unknown)}; there are {NAMES}\n")
        return 2
    failed = 0
    for name in wanted:
        print(f"\n== {name}", flush=True)
        command = [sys.executable, "-m", f"benchmarks.{name}"]
        failed = failed or subprocess.run(command, cwd=ROOT, check=False).returncode
    return failed


if __name__ == "__main__":
    sys.exit(main())
