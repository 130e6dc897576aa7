"""Run every test; those of real time that fail are run once more, alone.

Where nothing is judged by how long it takes, two run at a time, those that take long
first, and three of real agents, which wait more than they work: one of the three begins
with the tests of three machines, which wait most. The rest has the machine to itself. A
test of real agents or of real time that fails, and passes when it is run again, is
printed as FLAKY: it is to be mended. More than a few such failures, or any other one,
end with status 1.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
CACHE: Final = ROOT / ".pytest_cache" / "v" / "cache" / "lastfailed"
BESIDE: Final = ("deploy", "native", "scripted", "unit", "property", "typing")
AGENTS: Final = ("hosts", "agents")
ALONE: Final = ("integration",)
REAL: Final = ("tests/agents/", "tests/integration/", "tests/hosts/")
MOST_AGAIN: Final = 8


def run(*arguments: str) -> tuple[int, list[str]]:
    """Run pytest; return its status and the tests that failed."""
    command = [sys.executable, "-m", "pytest", "--cache-clear", *arguments]
    status = subprocess.run(command, cwd=ROOT, check=False).returncode
    failed = list(json.loads(CACHE.read_text())) if CACHE.exists() else []
    return status, failed


def main() -> int:
    """Run all parts, then what failed of real time; return the exit status."""
    parts = (
        run("-n", "2", "--dist", "worksteal", *(f"tests/{one}" for one in BESIDE)),
        run("-n", "3", "--dist", "worksteal", *(f"tests/{one}" for one in AGENTS)),
        run(*(f"tests/{one}" for one in ALONE)),
    )
    failed = [test for _, tests in parts for test in tests]
    if not failed or any(status not in {0, 1} for status, _ in parts):
        return max(status for status, _ in parts)
    if len(failed) > MOST_AGAIN or not all(one.startswith(REAL) for one in failed):
        return 1
    print("\nonce more, alone:", *failed, sep="\n  ", flush=True)
    status, still = run(*failed)
    for test in failed:
        if test not in still:
            print(f"FLAKY {test}")
    return status


if __name__ == "__main__":
    sys.exit(main())
