r"""What it costs an agent that its metrics are read each second.

Two agents run the PUMA's job for real. Turn by turn nobody reads the metrics of arm1
(A), or they are read once a second (B). Printed are the CPU time of that agent's own
process in percent of a core, and the releases that its tasks have missed.

Goal: reading takes at most 1 % of a core more than none.

    python -m benchmarks.metrics [--seconds 10] [--turns 5] [--quick]
"""

from __future__ import annotations

import argparse
import contextlib
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from statistics import fmean

from benchmarks.web import start
from pbonet.master.configuration import Place
from pbonet.master.console import oneshot

PUMA = Path(__file__).parents[1] / "examples" / "puma" / "puma.job"
GOAL = 1.0
"""Most of a core in percent that reading may take."""


def free_port() -> int:
    """Return a port that no program has now."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def cpu(process: int) -> float:
    """Return the CPU seconds of all threads of a process that live."""
    spent = 0
    for path in Path(f"/proc/{process}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):
            spent += int(path.read_text().split()[0])
    return spent * 1e-9


def read_for(seconds: float, url: str) -> int:
    """Read the metrics once a second; return how many bytes one answer has."""
    end, size = time.monotonic() + seconds, 0
    due = time.monotonic()
    while due < end:
        if url:
            with urllib.request.urlopen(url, timeout=10) as answer:  # noqa: S310
                size = len(answer.read())
        due += 1.0
        time.sleep(max(min(due, end) - time.monotonic(), 0.0))
    return size


def missed(place: Place) -> int:
    """Return how many releases the tasks have missed since they were turned on."""
    status = oneshot.run(PUMA, "status", {"fields": "miss"}, place)
    return sum(int(task["fields"]["miss"]) for task in status.data["tasks"])


def measure(seconds: float, turns: int) -> dict[bool, list[float]]:
    """Run the job; print a line for each turn.

    Returns:
        CPU of the agent in percent, without and with readings.
    """
    found: dict[bool, list[float]] = {False: [], True: []}
    domain, port = f"bench{secrets.token_hex(3)}", free_port()
    place = Place(domain=domain)
    cli = [sys.executable, "-m", "pbonet.cli"]
    agents: list[subprocess.Popen[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder, "agent.toml")
        settings.write_text(f'metrics = "127.0.0.1:{port}"\n')
        more = ["--domain", domain, "--runs", folder]
        try:
            for name, own in (("arm0", []), ("arm1", ["--config", str(settings)])):
                words = [*cli, "agent", "--name", name, *own, *more]
                agents.append(start(words, "ready")[0])
            oneshot.run(PUMA, "start", {}, place)
            url = f"http://127.0.0.1:{port}/metrics"
            print("read  agent %  bytes  missed")
            for number in range(2 * turns):
                read = number % 2 == 1
                since, before = missed(place), cpu(agents[1].pid)
                begun = time.monotonic()
                size = read_for(seconds, url if read else "")
                passed = time.monotonic() - begun
                share = 100 * (cpu(agents[1].pid) - before) / passed
                lost = missed(place) - since
                found[read].append(share)
                print(f"{read:4}  {share:7.2f}  {size:5}  {lost:6}", flush=True)
        finally:
            if len(agents) > 1:
                oneshot.run(PUMA, "stop", {}, place)
            for one in agents:
                one.send_signal(signal.SIGINT)
                one.communicate()
    return found


def main() -> None:
    """Measure."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--seconds", type=float, default=10.0)
    words.add_argument("--turns", type=int, default=5)
    words.add_argument("--quick", action="store_true", help="3 s, once")
    given = words.parse_args()
    seconds, turns = (3.0, 1) if given.quick else (given.seconds, given.turns)
    found = measure(seconds, turns)
    plain, read = fmean(found[False]), fmean(found[True])
    good = read - plain <= GOAL
    print(
        f"agent {plain:.2f} % without readings, {read:.2f} % with one a second: "
        f"{read - plain:+.2f} % (goal {GOAL:g}): {'met' if good else 'MISSED'}"
    )
    if not (good or given.quick):
        sys.exit(3)


if __name__ == "__main__":
    main()
