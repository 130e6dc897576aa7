"""How fast a verb starts: whole commands, each beside a program that does the least.

First `run` of the PUMA's job, without agents, from the start of the command as a
process to the first cycle of each task, which the log of the run has.

The others are run in turn, in every round, while a job of four tasks runs on two RTPUs:
``--version`` beside an empty program, `status` beside one that imports what no status
can do without, `check` of a job, and what bash is offered for a word. The medians are
judged. Status 3: a goal was missed.

    python -m benchmarks.startup [--rounds 20] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import rtbench
from pbonet.cli.completing import SCRIPTS
from pbonet.log import Log, last_run
from pbonet.xm.net import messages, rpc, session

if TYPE_CHECKING:
    from collections.abc import Generator

PUMA = Path(__file__).resolve().parents[1] / "examples" / "puma"
JOB = PUMA / "puma.job"
DOMAIN = "startup"
BARE, LEAST = "python -c pass", "python -c 'import zenoh, msgspec, rich.table'"
VERSION, STATUS, CHECK = "pbonet --version", "pbonet status", "pbonet check puma.job"
COMPLETION = "completion in bash"
GOALS = {VERSION: 4.0, STATUS: 1.5}
"""How many times as long as the program beside it it may take."""
CHECK_CPU = 0.35
"""Seconds of CPU time."""
COMPLETION_TIME = 0.15
"""Seconds."""
RUN = "pbonet run puma.job to the first cycle of "
FIRST_CYCLE = 1.0
"""Seconds until every task has begun a cycle."""


def commands(folder: Path) -> dict[str, list[str]]:
    """Return the command lines, by their names."""
    program = folder / "pbonet"
    main = "import sys\nfrom pbonet.cli import main\nsys.exit(main())\n"
    program.write_text(f"#!{sys.executable}\n{main}")
    program.chmod(0o755)
    words = ("pbonet", "status", str(JOB), "jttr")
    asked = (
        f"PATH={folder}:$PATH\n{SCRIPTS['bash']}"
        f"COMP_WORDS=({' '.join(words)}); COMP_CWORD=3; _pbonet\n"
        "test ${COMPREPLY[0]} = jttrace"
    )
    return {
        BARE: [sys.executable, "-c", "pass"],
        VERSION: [str(program), "--version"],
        LEAST: [sys.executable, "-c", "import zenoh, msgspec, rich.table"],
        STATUS: [str(program), "status", str(JOB), "--domain", DOMAIN],
        CHECK: [str(program), "check", str(JOB)],
        COMPLETION: ["bash", "-c", asked],
    }


def first_cycles(program: str, folder: Path) -> list[float]:
    """Return the seconds from the start of `run` to each task's first cycle, sorted."""
    words = ("--domain", f"{DOMAIN}-run", "--seconds", "0.2", "--runs", str(folder))
    begin = time.monotonic_ns()
    timed([program, "run", str(JOB), *words])
    log = Log(last_run(folder))
    starts = [int(log.arrays(task)["start_ns"][0]) for task in log.tasks]
    return sorted((start - begin) * 1e-9 for start in starts)


def runs(rounds: int, folder: Path) -> dict[str, list[float]]:
    """Return the seconds of `run` to the first and to the last task's first cycle."""
    program = commands(folder)[VERSION][0]
    first_cycles(program, folder / "compiled")
    found = [first_cycles(program, folder / f"run{k}") for k in range(rounds)]
    return {
        f"{RUN}the first task": [one[0] for one in found],
        f"{RUN}the last task": [one[-1] for one in found],
    }


@contextmanager
def running() -> Generator[None]:
    """Have the job run meanwhile."""
    words = ("run", str(JOB), "--domain", DOMAIN, "--record", "off")
    command = [sys.executable, "-m", "pbonet.cli", *words]
    job = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert job.stdout is not None
    try:
        while "is ON" not in (line := job.stdout.readline()):
            assert line, "the job did not start"
        yield
    finally:
        job.terminate()
        job.stdout.close()
        job.wait(60)


def timed(command: list[str]) -> tuple[float, float]:
    """Return the seconds that a command takes, and those of CPU time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    took = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return took, cpu


def round_trip(times: int) -> float:
    """Return the median seconds of one question to one RTPU."""
    client = rpc.Client(session.client(DOMAIN), DOMAIN, "startup-bench")
    found: list[float] = []
    try:
        rtpu = client.rtpus()[0]
        for _ in range(times):
            begin = time.perf_counter()
            client.call(rtpu, messages.Status(), messages.RtpuStatus)
            found.append(time.perf_counter() - begin)
    finally:
        client.close()
    return statistics.median(found)


def measure(
    rounds: int, folder: Path
) -> tuple[dict[str, list[float]], dict[str, list[float]], float]:
    """Return wall times and CPU times of each command, and a round trip's time."""
    wanted = commands(folder)
    wall: dict[str, list[float]] = {name: [] for name in wanted}
    cpu: dict[str, list[float]] = {name: [] for name in wanted}
    with running():
        for command in wanted.values():
            timed(command)  # what is compiled once is compiled now
        for _ in range(rounds):
            for name, command in wanted.items():
                took, used = timed(command)
                wall[name].append(took)
                cpu[name].append(used)
        return wall, cpu, round_trip(rounds)


def main() -> None:
    """Measure, print a table in milliseconds, and judge the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="pbonet-", dir="/tmp") as folder:
        os.environ["PBONET_RUN_DIR"] = folder
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # as for a user's program
        started = runs(args.rounds, Path(folder))
        wall, cpu, trip = measure(args.rounds, Path(folder))
    print(rtbench.machine())
    print(f"{'ms, median':52}{'wall':>8}{'longest':>9}{'CPU':>8}")
    for name, times in started.items():
        wall_ms = statistics.median(times) * 1e3
        print(f"{name:52}{wall_ms:8.0f}{max(times) * 1e3:9.0f}")
    middle = {name: statistics.median(times) for name, times in wall.items()}
    for name, times in wall.items():
        used = statistics.median(cpu[name])
        row = f"{middle[name] * 1e3:8.0f}{max(times) * 1e3:9.0f}{used * 1e3:8.0f}"
        print(f"{name:52}{row}")
    print(f"{'one round trip to an RTPU':52}{trip * 1e3:8.1f}")
    if args.json:
        found = {"run": started, "wall": wall, "cpu": cpu, "round trip": trip}
        args.json.write_text(json.dumps(found, indent=1))
    of_version = middle[VERSION] / middle[BARE]
    of_status = (middle[STATUS] - trip) / middle[LEAST]
    checked = statistics.median(cpu[CHECK])
    rtbench.judge([
        rtbench.verdict(
            f"{VERSION}, times an empty program", of_version, GOALS[VERSION]
        ),
        rtbench.verdict(f"{STATUS}, times {LEAST}", of_status, GOALS[STATUS]),
        rtbench.verdict(f"{CHECK}, s of CPU time", checked, CHECK_CPU),
        rtbench.verdict(f"{COMPLETION}, s", middle[COMPLETION], COMPLETION_TIME),
        *(
            rtbench.verdict(f"{name}, s", statistics.median(times), FIRST_CYCLE)
            for name, times in started.items()
        ),
    ])


if __name__ == "__main__":
    main()
