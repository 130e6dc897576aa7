"""A run of the PUMA example for an hour: does any of its processes grow?

Each minute it prints, for every process of the run, the resident memory that is the
process's own (anonymous pages), its share of all memory (PSS) and its descriptors, and
the size of everything in the run's shared memory. At the end it prints the slope of
each over the second half, and ends with status 3 if a process grew by more than
0.5 kB/s, by a descriptor, or shared memory by a page.

    python -m benchmarks.soak [--minutes 60] [--job FILE] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from benchmarks.kills import processes

if TYPE_CHECKING:
    from collections.abc import Sequence

JOB = Path(__file__).parents[1] / "examples" / "puma" / "puma.job"
PERIOD = 60.0
MOST_SLOPE = 0.5
"""Goal: kB/s of a process's own memory over the second half."""
END_TIME = 30.0
"""Seconds in which a run must end, however long it was."""
MISSED = 3
T = TypeVar("T")
FIELDS = ("own kB", "PSS kB", "descriptors")


class Sample(NamedTuple):
    """One process at one time."""

    seconds: float
    own_kb: int
    pss_kb: int
    descriptors: int


def memory(pid: int) -> tuple[int, int]:
    """Return a process's anonymous memory and its share of all memory, in kB."""
    found: dict[str, int] = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]:
        name, _, rest = line.partition(":")
        found[name] = int(rest.split()[0])
    return found["Anonymous"], found["Pss"]


def name_of(pid: int, role: str) -> str:
    """Return a name of a process that says which one of its kind it is."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    comm = Path(f"/proc/{pid}/comm").read_text().strip()
    which = words[words.index(b"--name") + 1].decode() if b"--name" in words else ""
    return f"{role} {which or (comm if role == 'task' else '')}".strip() + f" {pid}"


class Soak:
    """Samples of all processes of a run.

    Args:
        folder: The run's runtime folder.
        shared: The run's folder of shared memory.
    """

    def __init__(self, folder: Path, shared: Path) -> None:
        self._folder, self._shared = folder, shared
        self.samples: dict[str, list[Sample]] = {}
        self.shared: list[tuple[float, int]] = []

    def take(self, seconds: float) -> None:
        """Take a sample of every process, and print it."""
        print(f"-- {seconds / 60:.0f} min", flush=True)
        for pid, role in sorted(processes(self._folder).items()):
            with contextlib.suppress(OSError, ValueError):
                name = name_of(pid, role)
                count = len(list(Path(f"/proc/{pid}/fd").iterdir()))
                one = Sample(seconds, *memory(pid), count)
                self.samples.setdefault(name, []).append(one)
                print(f"{name:30} {one.own_kb:8} {one.pss_kb:8} {one.descriptors:5}")
        size = sum(one.stat().st_blocks * 512 for one in self._shared.iterdir())
        self.shared.append((seconds, size))
        print(f"{'shared memory':30} {size >> 10:8} kB", flush=True)

    def slopes(self) -> dict[str, dict[str, float]]:
        """Return the growth per second over the second half, by process."""
        found = {
            name: {
                field: slope([(one[0], float(one[k])) for one in samples])
                for k, field in enumerate(FIELDS, 1)
            }
            for name, samples in self.samples.items()
        }
        shared = [(seconds, size / 1024) for seconds, size in self.shared]
        return {**found, "shared memory": {"kB": slope(shared)}}

    def grown(self) -> list[str]:
        """Return what has grown over the second half."""
        found: list[str] = []
        for name, samples in self.samples.items():
            half = later(samples)
            own = slope([(one.seconds, float(one.own_kb)) for one in samples])
            if own > MOST_SLOPE:
                found.append(f"{name}: {own:.2f} kB/s")
            if half[-1].descriptors > half[0].descriptors:
                found.append(f"{name}: {half[-1].descriptors} descriptors")
        sizes = [size for _, size in later(self.shared)]
        if sizes[-1] > sizes[0]:
            found.append(f"shared memory: {sizes[-1] - sizes[0]} bytes")
        return found


def later(samples: Sequence[T]) -> Sequence[T]:
    """Return the second half."""
    return samples[len(samples) // 2 :]


def slope(points: Sequence[tuple[float, float]]) -> float:
    """Return the slope of a line through the second half of the points."""
    half = later(points)
    if len(half) < 2:
        return 0.0
    times, values = zip(*half, strict=True)
    return float(np.polyfit(times, values, 1)[0])


def measure(job: Path, minutes: float) -> Soak:
    """Run a job, and take samples each minute."""
    with contextlib.ExitStack() as its:
        folder = Path(its.enter_context(tempfile.TemporaryDirectory()))
        in_memory = tempfile.TemporaryDirectory(dir="/dev/shm", prefix="soak")
        shared = Path(its.enter_context(in_memory))
        environ = {
            **os.environ,
            "PBONET_RUN_DIR": str(folder),
            "PBONET_SHM_DIR": str(shared),
        }
        command = [sys.executable, "-m", "pbonet.cli", "run", str(job)]
        command += ["--domain", f"soak{os.getpid()}", "--runs", str(folder / "runs")]
        said = its.enter_context((folder / "said").open("wb"))
        run = subprocess.Popen(command, env=environ, stdout=said, stderr=said)
        its.callback(end, run)
        wait_on(run, folder / "said")
        soak = Soak(folder, shared)
        begin = time.monotonic()
        for number in range(int(minutes * 60 / PERIOD) + 1):
            time.sleep(max(0.0, begin + number * PERIOD - time.monotonic()))
            if run.poll() is not None:
                raise SystemExit((folder / "said").read_text())
            soak.take(time.monotonic() - begin)
        return soak


def wait_on(run: subprocess.Popen[bytes], said: Path) -> None:
    """Wait until the job is ON."""
    while b" is ON" not in said.read_bytes():
        if run.poll() is not None:
            raise SystemExit(said.read_text())
        time.sleep(0.1)


def end(run: subprocess.Popen[bytes]) -> None:
    """End the run in order."""
    if run.poll() is None:
        begun = time.monotonic()
        run.send_signal(signal.SIGINT)
        run.wait(END_TIME)
        print(f"the run ended {time.monotonic() - begun:.1f} s after the interrupt")


def main() -> int:
    """Measure, print the slopes, and judge them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--job", type=Path, default=JOB)
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    soak = measure(told.job, told.minutes)
    slopes = soak.slopes()
    print("-- growth per second over the second half")
    for name, found in slopes.items():
        print(f"{name:30}", *(f"{key} {value:+.4f}" for key, value in found.items()))
    if told.json:
        found_ = {"samples": soak.samples, "shared": soak.shared, "slopes": slopes}
        told.json.write_text(json.dumps(found_))
    grown = soak.grown()
    print(*(grown or ["nothing has grown"]), sep="\n")
    return MISSED if grown else 0


if __name__ == "__main__":
    sys.exit(main())
