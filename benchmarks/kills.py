"""Random processes of a run killed, crashed or stopped: is the machine clean after it?

Each round starts `pbonet run` of a servo and sends SIGKILL, SIGSEGV or SIGSTOP to one
or two processes: master, agent, RTPU process, fork server, task, recorder. Half a
second later the run is interrupted, if it still runs. Ends with status 3 when a run did
not end within its limit, or a process of it was alive 2 s after its end, or its exit
status was 0 although a task of it was killed, or shared memory is left after a last run
that nothing disturbs. The next round finds out whether a new run works at once; a
master that was stopped is killed, as only its user can continue it.

    python -m benchmarks.kills [--rounds 200] [--seed 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

JOB = Path(__file__).parents[1] / "examples" / "puma" / "puma.job"
SIGNALS = (signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP)
START_TIME = 60.0
END_TIME = 30.0
"""Seconds in which an interrupted run must end, whatever of it was stopped."""
CLEAN_TIME = 2.0
ROLES = {
    "pbonet-rtpu": "RTPU process",
    "pbonet-forks": "fork server",
    "pbonet-recorder": "recorder",
}
"""What a process is, by the name that ``ps -o comm`` shows; agents have pbonet's."""


def processes(folder: Path) -> dict[int, str]:
    """Return the living processes of a runtime folder, with what each of them is."""
    wanted = f"PBONET_RUN_DIR={folder}".encode()
    found: dict[int, str] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if wanted not in (entry / "environ").read_bytes().split(b"\0"):
                continue
            name = (entry / "comm").read_text().strip()
            command = (entry / "cmdline").read_bytes().split(b"\0")
            if (entry / "stat").read_text().rpartition(")")[2].split()[0] in "ZX":
                continue
            found[int(entry.name)] = role_of(name, command)
    return found


def role_of(name: str, command: list[bytes]) -> str:
    """Return what a process is, also before it has set its name."""
    if name in ROLES:
        return ROLES[name]
    if b"pbonet.cli" in command:
        return "agent" if b"agent" in command else "master"
    if name.startswith("python"):
        return "process that starts"
    return "task"


class RoundError(Exception):
    """What was wrong after a round."""


class Rounds:
    """Runs of one job with processes that are killed.

    Args:
        folder: An empty folder for everything that the runs write.
        seed: Of the random choices.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.chance = random.Random(seed)
        self.ends: list[float] = []
        """Seconds from the interrupt to the end of each run."""
        self.faults: list[str] = []
        (folder / "shm").mkdir()
        (folder / "run").mkdir(mode=0o700)
        self._env = {
            **os.environ,
            "PBONET_RUN_DIR": str(folder / "run"),
            "PBONET_SHM_DIR": str(folder / "shm"),
        }

    def round(self, number: int, *, harmed: bool = True) -> None:
        """Start a run, harm it, and note what was wrong afterwards."""
        said = (self.folder / "said").open("w+")
        words = ["run", str(JOB), "--domain", "kills", "--runs", self.folder / "runs"]
        run = subprocess.Popen(
            [sys.executable, "-m", "pbonet.cli", *map(str, words)],
            env=self._env,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
        )
        done = "start"
        try:
            self._wait_on(run, Path(said.name))
            done = self._harm(run) if harmed else "undisturbed"
            self._end(run)
            self._judge(run.returncode, done)
        except RoundError as error:
            self.faults.append(f"round {number}, {done}: {error}")
            print(self.faults[-1], flush=True)
        finally:
            for pid in processes(self.folder / "run"):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            run.wait()
            said.close()

    def _wait_on(self, run: subprocess.Popen[bytes], said: Path) -> None:
        deadline = time.monotonic() + START_TIME
        while " is ON: " not in (text := said.read_text()):
            if run.poll() is not None or time.monotonic() > deadline:
                raise RoundError(f"the run did not start: {text[-500:]}")
            time.sleep(0.02)

    def _harm(self, run: subprocess.Popen[bytes]) -> str:
        """Send signals to random processes; return what was done."""
        done: list[str] = []
        time.sleep(self.chance.random() * 0.5)
        for _ in range(self.chance.choice((1, 1, 2))):
            there = processes(self.folder / "run")
            role = self.chance.choice(sorted(set(there.values())))
            pid = self.chance.choice([p for p, is_ in there.items() if is_ == role])
            which = self.chance.choice(SIGNALS)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, which)
            done.append(f"{which.name} to {role}")
            time.sleep(self.chance.random() * 0.2)
        if "SIGSTOP to master" in done:
            run.kill()
        time.sleep(0.5)
        return " and ".join(done)

    @staticmethod
    def _judge(status: int, done: str) -> None:
        if status == 0 and ("SIGKILL to task" in done or "SIGSEGV to task" in done):
            raise RoundError("exit status 0 although a task was killed")

    def _end(self, run: subprocess.Popen[bytes]) -> None:
        begun = time.monotonic()
        if run.poll() is None:
            run.send_signal(signal.SIGINT)
        try:
            run.wait(END_TIME)
        except subprocess.TimeoutExpired:
            raise RoundError(f"the run stands after {END_TIME:g} s") from None
        self.ends.append(time.monotonic() - begun)
        deadline = time.monotonic() + CLEAN_TIME
        while left := processes(self.folder / "run"):
            if time.monotonic() > deadline:
                names = ", ".join(left.values())
                raise RoundError(f"alive {CLEAN_TIME:g} s after the end: {names}")
            time.sleep(0.02)


def measure(rounds: int, seed: int) -> Rounds:
    """Make rounds in a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="pbonet-kills-") as folder:
        made = Rounds(Path(folder), seed)
        for number in range(rounds):
            made.round(number)
        made.round(rounds, harmed=False)
        left = sorted(one.name for one in (Path(folder) / "shm").iterdir())
        if left:
            made.faults.append(f"left in shared memory: {', '.join(left)}")
            print(made.faults[-1], flush=True)
        return made


def main() -> int:
    """Run the benchmark; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    asked = parser.parse_args()
    made = measure(asked.rounds, asked.seed)
    print(f"{asked.rounds} rounds, {len(made.faults)} faults")
    if made.ends:
        p50, p99, most = np.quantile(made.ends, (0.5, 0.99, 1.0))
        print(f"interrupt to end: p50 {p50:.2f} s, p99 {p99:.2f} s, max {most:.2f} s")
    if asked.json:
        text = json.dumps({"ends": made.ends, "faults": made.faults})
        asked.json.write_text(text, encoding="utf-8")
    return 0 if not made.faults else 3


if __name__ == "__main__":
    sys.exit(main())
