"""Verbs while agents are stopped: how long it takes until the error stands there.

Two real agents, stopped by SIGSTOP just before each verb; the whole command is timed,
from its start as a process to its end. Status 3: a goal was missed.

    python -m benchmarks.unreachable [--rounds 10] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import rtbench

SBS = Path(__file__).resolve().parents[1] / "examples" / "puma" / "puma.sbs"
NAMES = ("arm0", "arm1")
VERBS = (
    ("status", str(SBS)),
    ("on", str(SBS), "puma_pidg"),
    ("off", str(SBS), "puma_pidg"),
    ("spawn", str(SBS), "puma_pidg"),
    ("kill", str(SBS), "puma_pidg"),
    ("stop", "puma"),
)
CASES = {"none": (), "one of two": ("arm1",), "the table's": ("arm0",), "both": NAMES}
LONGEST = 2.0
"""Seconds that a command may take until its error stands there."""
RESUME = 0.6
"""Seconds in which agents that go on are seen by each other again."""


def pbonet(*words: str) -> list[str]:
    """Return the command line of a verb."""
    return [sys.executable, "-m", "pbonet.cli", *words]


def timed(words: tuple[str, ...]) -> float:
    """Run a verb to its end and return the seconds it took."""
    begin = time.monotonic()
    subprocess.run(pbonet(*words), capture_output=True, check=False, timeout=30)
    return time.monotonic() - begin


def measure(
    agents: dict[str, subprocess.Popen[str]], rounds: int
) -> dict[str, dict[str, list[float]]]:
    """Return the times of each verb in each case, case after case in every round."""
    found: dict[str, dict[str, list[float]]] = {
        words[0]: {case: [] for case in CASES} for words in VERBS
    }
    for _ in range(rounds):
        for words in VERBS:
            for case, names in CASES.items():
                for name in names:
                    agents[name].send_signal(signal.SIGSTOP)
                found[words[0]][case].append(timed(words))
                for name in names:
                    agents[name].send_signal(signal.SIGCONT)
                time.sleep(RESUME)
    return found


def main() -> None:
    """Measure and print a table in seconds: median and longest; judge the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="pbonet-", dir="/tmp") as folder:
        os.environ["PBONET_RUN_DIR"] = folder
        agents = {
            name: subprocess.Popen(
                pbonet("agent", "--name", name), stdout=subprocess.PIPE, text=True
            )
            for name in NAMES
        }
        try:
            for agent in agents.values():
                assert agent.stdout is not None
                agent.stdout.readline()  # it is ready
            found = measure(agents, args.rounds)
        finally:
            for agent in agents.values():
                agent.terminate()
            for agent in agents.values():
                agent.wait(30)
    print(rtbench.machine())
    print("seconds, median / longest, by which agents are stopped")
    print(f"{'verb':8}" + "".join(f"{case:>16}" for case in CASES))
    for verb, cases in found.items():
        cells = (
            f"{np.median(times):.2f} / {max(times):.2f}" for times in cases.values()
        )
        print(f"{verb:8}" + "".join(f"{cell:>16}" for cell in cells))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))
    rtbench.judge(
        rtbench.verdict(f"{verb}, {case} stopped, s, median", float(median), LONGEST)
        for verb, cases in found.items()
        for case, times in cases.items()
        for median in [np.median(times)]
    )


if __name__ == "__main__":
    main()
