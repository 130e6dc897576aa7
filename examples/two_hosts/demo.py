"""Two subsystems on two hosts, a master on a third, and a cable that is pulled.

    python examples/two_hosts/demo.py            (root; or: make hosts-demo)

Makes three machines out of network namespaces, with a cable between each two. The arm
is on host a, what sees its target on host b, the master on host c. While the hand
follows the target the cable between a and b is pulled, and plugged in again. Nobody
clears, restarts or connects anything; nothing is left behind.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.testing.lan import Lan, missing

if TYPE_CHECKING:
    from collections.abc import Generator

HERE = Path(__file__).parent
PORT = 7447
PULLED, PLUGGED, AFTER, LONGEST = 3.0, 5.0, 2.0, 30.0
"""When the cable is pulled and plugged in, how long all goes on after that, and how
long it lasts at most, s."""
FRESH = 0.25
"""A target younger than this is seen, s."""
READY = 30.0
"""Seconds that agents may take to start."""


class Hosts:
    """Three hosts, and the processes on them.

    Args:
        lan: The machines.
    """

    def __init__(self, lan: Lan) -> None:
        self._lan = lan
        self._folders: dict[str, tuple[Path, Path]] = {}
        self._agents: list[tuple[str, subprocess.Popen[str]]] = []
        for name in lan.hosts:
            run = Path(tempfile.mkdtemp(prefix=f"pbonet-host-{name}-"))
            shared = Path(tempfile.mkdtemp(prefix=f"pbonet-host-{name}-", dir=_shm()))
            self._folders[name] = run, shared

    def start(self, host: str, *words: str) -> subprocess.Popen[str]:
        """Start a Python program on a host."""
        run, shared = self._folders[host]
        return subprocess.Popen(
            self._lan[host].command(sys.executable, *words),
            env={
                **os.environ,
                "PBONET_RUN_DIR": str(run),
                "PBONET_SHM_DIR": str(shared),
            },
            stdout=subprocess.PIPE,
            text=True,
        )

    def agent(self, name: str, host: str, *more: str) -> None:
        """Start an agent on a host."""
        words = ("-m", "pbonet.cli", "agent", "--name", name, *more)
        self._agents.append((host, self.start(host, *words)))

    def wait_ready(self) -> None:
        """Wait until every agent takes commands."""
        for host, process in self._agents:
            told = process.stdout.readline() if process.stdout else ""
            if "ready" not in told:
                raise SystemExit(f"an agent on host {host} did not start: {told}")
            sys.stdout.write(f"host {host}: {told}")

    def close(self) -> None:
        """End every agent, and remove what hosts had."""
        for _, process in self._agents:
            process.terminate()
        for _, process in self._agents:
            process.wait(READY)
            if process.stdout:
                process.stdout.close()
        for folder in (one for pair in self._folders.values() for one in pair):
            shutil.rmtree(folder)


def _shm() -> str:
    return "/dev/shm"  # noqa: S108 - where shared memory is


@contextlib.contextmanager
def hosts() -> Generator[tuple[Lan, Hosts], None, None]:
    """Make three hosts with agents; take everything away at the end."""
    lan = Lan()
    made = Hosts(lan)
    try:
        anywhere = ("--listen", f"tcp/[::]:{PORT}", "--insecure")
        made.agent("arm0", "a", *anywhere)
        made.agent("arm1", "a")
        made.agent(
            "eye0", "b", *anywhere, "--connect", f"tcp/{lan['a'].address('b')}:{PORT}"
        )
        made.wait_ready()
        yield lan, made
    finally:
        made.close()
        lan.close()


class Timeline:
    """Pulls the cable and plugs it in while the master's lines pass by.

    Args:
        lan: The machines.
    """

    def __init__(self, lan: Lan) -> None:
        self._lan = lan
        self._stage = 0
        self._plugged = 0.0
        self.oldest = 0.0
        """The greatest age of the target that was seen, s."""
        self.healed: float | None = None
        """Seconds from the plug to a fresh target."""
        self.over = False
        """Whether there is nothing more to be seen."""

    def pass_by(self, line: str) -> None:
        """Print a line, and do what is due at its time."""
        sys.stdout.write(line)
        sys.stdout.flush()
        words = line.split()
        try:
            now, age = float(words[0]), float(words[1]) * 1e-3
        except (ValueError, IndexError):
            return
        self.oldest = max(self.oldest, age)
        if self._stage == 0 and now >= PULLED:
            self._lan.cut("a", "b")
            self._next("-- the cable between a and b is pulled")
        elif self._stage == 1 and now >= PLUGGED:
            self._lan.heal("a", "b")
            self._plugged = time.monotonic()
            self._next("-- and plugged in again")
        elif self._stage == 2 and age < FRESH:  # noqa: PLR2004 - plugged in
            self.healed = time.monotonic() - self._plugged
            self._next(f"-- the arm sees its target again, after {self.healed:.1f} s")
        elif self._stage == len(("pulled", "plugged", "seen")):
            self.over = time.monotonic() > self._plugged + AFTER

    def _next(self, text: str) -> None:
        self._stage += 1
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def main() -> None:
    """Run the demonstration."""
    if why := missing():
        sys.exit(f"demo: {why}")
    with hosts() as (lan, made):
        here = f"tcp/{lan['a'].address('c')}:{PORT}"
        words = (str(HERE / "steer.py"), "--connect", here, "--seconds", f"{LONGEST}")
        master = made.start("c", *words)
        timeline = Timeline(lan)
        try:
            for line in master.stdout or ():
                timeline.pass_by(line)
                if timeline.over:
                    break
        finally:
            master.terminate()
            status = master.wait(READY)
    if status or timeline.healed is None:
        sys.exit("demo: the arm did not see its target again")
    sys.stdout.write(
        f"the oldest target that the arm went by was {timeline.oldest:.1f} s old; "
        f"{timeline.healed:.1f} s after the plug it saw it again\n"
    )


if __name__ == "__main__":
    main()
