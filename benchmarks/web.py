r"""What the page costs: the server, the agents, and the tasks that it shows.

The PUMA's job runs for real. Turn by turn nobody looks (A), and one browser and then
five look at all variables at 20 Hz (B). Printed are, for each turn: the CPU of the
server and of all agents with their tasks, in percent of a core; values that came a
second; and releases that the 500 Hz task missed. A browser is here a client of the
socket that reads all that comes.

Goals: the server takes at most 6 % with one browser and 9 % with five, the agents at
most 2 % more than without.

    python -m benchmarks.web [--seconds 60] [--turns 2] [--quick]
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import fmean
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from pbonet.master.configuration import Place
from pbonet.master.console import oneshot

PUMA = Path(__file__).parents[1] / "examples" / "puma" / "puma.job"
WATCHED = ["Q_MEZ", "Q^_MEZ", "Q_REF", "Q^_REF", "T_GRAV"]
BROWSERS = 0, 1, 5
GOALS = {1: 6.0, 5: 9.0}
"""Most of a core in percent that the server may take, by browsers."""
AGENTS_GOAL = 2.0
TASK = "puma_pidg"
_TICKS = os.sysconf("SC_CLK_TCK")


class Browser:
    """A client that watches and counts.

    Args:
        url: The server.
        cookie: Which lets it in.
    """

    def __init__(self, url: str, cookie: str) -> None:
        self.values = 0
        self.bytes = 0
        self._open = contextlib.ExitStack()
        self._socket: ClientConnection = self._open.enter_context(
            connect(
                url.replace("http", "ws") + "/ws",
                origin=Origin(url),
                additional_headers={"Cookie": cookie},
                max_size=2**24,
            )
        )
        self._socket.send(json.dumps({"do": "watch", "variables": WATCHED}))
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                text = self._socket.recv()
                self.bytes += len(text)
                self.values += '"kind":"values"' in str(text[:40])

    def close(self) -> None:
        """Leave."""
        self._open.close()
        self._thread.join()


def cpu(process: int) -> float:
    """Return the CPU seconds of a process."""
    try:
        text = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return 0.0
    fields = text.rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def family(process: int) -> list[int]:
    """Return a process and all its descendants."""
    found = [process]
    for one in found:
        for children in Path(f"/proc/{one}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                found += map(int, children.read_text().split())
    return found


def missed(place: Place) -> int:
    """Return how many releases the servo has missed since it was turned on."""
    data = oneshot.run(PUMA, "display", {"variable": ["Q_MEZ"]}, place).data
    assert data  # the subsystem answers
    status = oneshot.run(PUMA, "status", {"task": [TASK], "fields": "miss"}, place)
    return int(status.data["tasks"][0]["fields"]["miss"])


def start(command: list[str], until: str) -> tuple[subprocess.Popen[str], str]:
    """Start a program; return it, and the line in which it says that it is ready."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if until in line:
            return process, line
    raise SystemExit(f"{' '.join(command)} has ended")


def cookie_of(link: str) -> tuple[str, str]:
    """Return the server's address and a cookie, for a link that it printed."""
    url, _, query = link.partition("/?")
    asking = http.client.HTTPConnection(url.removeprefix("http://"))
    asking.request("GET", f"/?{query}")
    header = asking.getresponse().getheader("set-cookie") or ""
    asking.close()
    return url, header.partition(";")[0]


def turn(seconds: float, browsers: list[Browser], pids: dict[str, list[int]]) -> Any:  # noqa: ANN401
    """Let time pass; return what it cost."""
    before = {name: sum(map(cpu, some)) for name, some in pids.items()}
    counted = [one.values for one in browsers]
    begun = time.monotonic()
    time.sleep(seconds)
    passed = time.monotonic() - begun
    found = {
        name: 100 * (sum(map(cpu, some)) - before[name]) / passed
        for name, some in pids.items()
    }
    rates = [
        (one.values - at) / passed for one, at in zip(browsers, counted, strict=True)
    ]
    return found, min(rates, default=0.0)


def measure(seconds: float, turns: int) -> list[tuple[int, float, float]]:
    """Run the job and the server; print a line for each turn.

    Returns:
        For each turn browsers, and the CPU of server and agents in percent.
    """
    found: list[tuple[int, float, float]] = []
    domain = f"bench{secrets.token_hex(3)}"
    place = Place(domain=domain)
    with tempfile.TemporaryDirectory() as runs:
        cli = [sys.executable, "-m", "pbonet.cli"]
        run, _ = start(
            [*cli, "run", str(PUMA), "--domain", domain, "--runs", runs], "ON"
        )
        server, line = start(
            [*cli, "web", str(PUMA), "--domain", domain, "--port", "0", "--json"], "{"
        )
        url, cookie = cookie_of(json.loads(line)["observer"])
        try:
            print("browsers  server %  agents and tasks %  values/s  missed at 500 Hz")
            for _ in range(turns):
                for count in BROWSERS:
                    browsers = [Browser(url, cookie) for _ in range(count)]
                    time.sleep(2.0)  # what a browser is told at first
                    pids = {"server": [server.pid], "agents": family(run.pid)}
                    since = missed(place)
                    spent, rate = turn(seconds, browsers, pids)
                    more = missed(place) - since
                    print(
                        f"{count:8}  {spent['server']:8.2f}  {spent['agents']:18.2f}"
                        f"  {rate:8.1f}  {more:16}",
                        flush=True,
                    )
                    found.append((count, spent["server"], spent["agents"]))
                    for one in browsers:
                        one.close()
        finally:
            for process in (server, run):
                process.send_signal(signal.SIGINT)
                process.communicate()
    return found


def judged(found: list[tuple[int, float, float]]) -> bool:
    """Print the means and the goals; return whether all are met."""
    met = True
    plain = fmean(agents for count, _, agents in found if not count)
    for count, goal in GOALS.items():
        server = fmean(one for n, one, _ in found if n == count)
        more = fmean(one for n, _, one in found if n == count) - plain
        good = server <= goal and more <= AGENTS_GOAL
        met = met and good
        print(
            f"{count} browsers: server {server:.2f} % (goal {goal:g}), agents "
            f"{more:+.2f} % (goal {AGENTS_GOAL:g}): {'met' if good else 'MISSED'}"
        )
    return met


def main() -> None:
    """Measure."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--seconds", type=float, default=60.0)
    words.add_argument("--turns", type=int, default=2)
    words.add_argument("--quick", action="store_true", help="2 s, once")
    given = words.parse_args()
    seconds, turns = (2.0, 1) if given.quick else (given.seconds, given.turns)
    if not judged(measure(seconds, turns)) and not given.quick:
        sys.exit(3)


if __name__ == "__main__":
    main()
