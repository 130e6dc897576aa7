"""Links between subsystems: what they cost the writer, and how late records arrive.

    python -m benchmarks.tbuf [--rounds N] [--seconds S] [--markdown FILE]

Contestants take turns within every round, so that whatever else the machine does hits
all of them.

Cost, seen from Python, in nanoseconds:
    write       one call, nobody reads; the same with the time given; `numpy.copyto` of
                as many bytes as yardstick
    local       one call while a process on another core reads each millisecond
    wake-up     what a call takes longer, at 1 kHz, when the reader sleeps, as the agent
                of a remote reader does (a task rings behind its cycle, not in it)
    FUTEX_WAKE  the same of the system call alone, from C (futex.c), behind each
                wake-up: what waking a process costs here, whoever does it

Latency, at 1 kHz, in microseconds, from the writer's process to the reader's:
    pbonet      `Writer.write` to the return of `Reader.read` behind a wait, over two
                agents with shared memory of their own, linked by TCP
    raw zenoh   `put` to the callback between two processes, linked by TCP, as who
                knows zenoh sets it up: with the options that pbonet uses, and the
                callback in zenoh's own thread
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import timeit
from pathlib import Path
from typing import Self, cast

import numpy as np

from benchmarks import rtbench
from pbonet import tbuf, xm

SIZES = (48, 1024)
CALLS = 20_000
MOST_NS, WAKE_NS, SLOWEST = 100.0, 1500.0, 1.5
"""Goals: of a write, of a wake-up, and of the median latency in raw zenoh's."""
OTHER, SAME = "FUTEX_WAKE from C, another core", "FUTEX_WAKE from C, this core"
"""What the kernel takes, without any of pbonet."""
WARM_UP = 0.3
LOOP = """
import json, os, sys, time
import numpy as np
settings = json.loads(sys.argv[1])
size, period = settings["size"], 0.001
if "core" in settings:
    os.sched_setaffinity(0, {settings["core"]})
def paced(seconds):
    due = time.monotonic()
    for _ in range(int(seconds / period)):
        due += period
        time.sleep(max(0.0, due - time.monotonic()))
        yield
def tell(what):
    print(json.dumps(what), flush=True)
"""
OURS = """
from pbonet import tbuf, xm
xm.live_on(settings["home"], domain=settings["domain"])
"""
WRITER = (
    LOOP
    + OURS
    + """
end = tbuf.Writer("x", ("u1", size))
tell("ready")
for line in sys.stdin:
    for _ in paced(float(line)):
        end.write()
    tell("done")
"""
)
READER = (
    LOOP
    + OURS
    + """
end = tbuf.Reader("a:x", ("u1", size))
tell("ready")
for line in sys.stdin:
    if settings["poll"]:
        for _ in paced(float(line)):
            end.read()
        tell([])
        continue
    late, over = [], time.monotonic_ns() + int(float(line) * 1e9)
    while end.wait(over):
        if end.read():
            late.append(time.monotonic_ns() - end.stamp_ns)
    tell(late)
"""
)
RAW = """
import zenoh
def config(role, port):
    return zenoh.Config.from_json5(json.dumps({
        "mode": "peer", role: {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }))
"""
PUT = (
    LOOP
    + RAW
    + """
session = zenoh.open(config("listen", settings["port"]))
publisher = session.declare_publisher(
    "x",
    priority=zenoh.Priority.REAL_TIME,
    congestion_control=zenoh.CongestionControl.DROP,
    reliability=zenoh.Reliability.BEST_EFFORT,
)
rest = bytes(size - 8)
tell("ready")
for line in sys.stdin:
    for _ in paced(float(line)):
        publisher.put(time.monotonic_ns().to_bytes(8, "little") + rest)
    tell("done")
session.close()
"""
)
CALLBACK = (
    LOOP
    + RAW
    + """
late = []
def take(sample):
    data = sample.payload.to_bytes()
    late.append(time.monotonic_ns() - int.from_bytes(data[:8], "little"))
session = zenoh.open(config("connect", settings["port"]))
session.declare_subscriber("x", zenoh.handlers.Callback(take, indirect=False))
tell("ready")
for line in sys.stdin:
    late.clear()
    time.sleep(float(line))
    tell(late)
session.close()
"""
)


class Program:
    """A process that does something for as many seconds as it is told."""

    def __init__(self, code: str, env: dict[str, str], **settings: object) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, json.dumps(settings)],
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.result() == "ready"

    def go(self, seconds: float) -> None:
        """Begin."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()

    def result(self) -> object:
        """Return what came of it."""
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def end(self) -> None:
        """Let it end by itself."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10)


class Site:
    """A machine as far as links go: a shared memory, and an agent."""

    def __init__(self, name: str, domain: str, *arguments: str) -> None:
        base = "/dev/shm"  # noqa: S108 - shared memory
        self.folders = [tempfile.mkdtemp(dir=base), tempfile.mkdtemp()]
        shm, run = self.folders
        self.env = os.environ | {"PBONET_SHM_DIR": shm, "PBONET_RUN_DIR": run}
        words = ["agent", "--name", name, "--domain", domain, *arguments]
        self._agent = subprocess.Popen(
            [sys.executable, "-m", "pbonet.cli", *words],
            env=self.env,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._agent.stdout is not None
        self._agent.stdout.readline()

    def end(self) -> None:
        """End the agent and remove what it had."""
        self._agent.terminate()
        self._agent.wait(20)
        for folder in self.folders:
            shutil.rmtree(folder)


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Course:
    """Everybody who takes part in the measurement of latency, for one size."""

    def __init__(self, sites: tuple[Site, Site], domain: str, size: int) -> None:
        port = free_port()
        a, b = sites
        ours = {"size": size, "domain": domain, "poll": False}
        plain = {"size": size, "port": port}
        self._pairs = {
            "pbonet": (
                Program(WRITER, a.env, home="a", **ours),
                Program(READER, b.env, home="b", **ours),
            ),
            "raw zenoh": (
                Program(PUT, dict(os.environ), **plain),
                Program(CALLBACK, dict(os.environ), **plain),
            ),
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pair in self._pairs.values():
            for program in pair:
                program.end()

    def run(self, seconds: float) -> dict[str, list[float]]:
        """Return each contestant's latencies in microseconds."""
        found: dict[str, list[float]] = {}
        for name, (source, sink) in self._pairs.items():
            sink.go(seconds + 2 * WARM_UP)
            time.sleep(WARM_UP)
            source.go(seconds)
            source.result()
            late = cast("list[int]", sink.result())
            found[name] = [ns / 1000 for ns in late]
        return found


def latencies(rounds: int, seconds: float) -> dict[tuple[int, str], list[float]]:
    """Return latencies in microseconds, by size and contestant."""
    domain, port = f"b{secrets.token_hex(3)}", free_port()
    where = f"tcp/127.0.0.1:{port}"
    sites = Site("a", domain, "--listen", where), Site("b", domain, "--connect", where)
    found: dict[tuple[int, str], list[float]] = {}
    try:
        for size in SIZES:
            with Course(sites, domain, size) as course:
                course.run(1.0)  # links come up, caches fill
                for _ in range(rounds):
                    for name, late in course.run(seconds).items():
                        found.setdefault((size, name), []).extend(late)
    finally:
        for site in sites:
            site.end()
    return found


def per_call(call: object) -> float:
    """Return nanoseconds of one call."""
    return timeit.timeit(call, number=CALLS) / CALLS * 1e9  # type: ignore[arg-type]


def paced_ns(writer: tbuf.Writer, count: int) -> float:
    """Return the median nanoseconds of a write at 1 kHz."""
    spent: list[int] = []
    for _ in range(count):
        time.sleep(0.001)
        begin = time.perf_counter_ns()
        writer.write()
        spent.append(time.perf_counter_ns() - begin)
    return statistics.median(spent)


def costs(rounds: int) -> dict[str, list[float]]:
    """Return nanoseconds by case, one of each round."""
    folder = tempfile.mkdtemp(dir="/dev/shm")
    os.environ["PBONET_SHM_DIR"] = folder
    xm.live_on("a", domain="bench")
    found: dict[str, list[float]] = {}
    first, *more = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {first})
    kernels = [
        str(rtbench.compile_c("futex", Path(folder))),
        *map(str, (first, *more[:1])),
    ]
    for size in SIZES:
        data = np.zeros(size, np.uint8)
        writer = tbuf.Writer("x", ("u1", size), data=data)
        home = {"home": "b", "domain": "bench", "size": size}
        home["core"] = more[0] if more else first
        env = dict(os.environ)
        poller = Program(READER, env, poll=True, **home)
        for _ in range(rounds):
            cases = {
                f"write, {size} B": writer.write,
                f"write, time given, {size} B": lambda w=writer: w.write(1),
                f"numpy.copyto, {size} B": lambda d=data: np.copyto(d, d),
            }
            for name, call in cases.items():
                found.setdefault(name, []).append(per_call(call))
            poller.go(0.3)
            ns = per_call(writer.write)
            found.setdefault(f"write, local reader, {size} B", []).append(ns)
            poller.result()
        poller.end()
        sleeper = Program(READER, env, poll=False, **home)
        _add_wake_up(found, writer, sleeper, rounds, kernels)
        writer.close()
    os.sched_setaffinity(0, {first, *more})
    shutil.rmtree(folder)
    del os.environ["PBONET_SHM_DIR"]
    return found


def _add_wake_up(
    found: dict[str, list[float]],
    writer: tbuf.Writer,
    sleeper: Program,
    rounds: int,
    kernels: list[str],
) -> None:
    """Add wake-ups, and behind each the kernel's own on another core and on this."""
    size = writer.value.nbytes
    for _ in range(rounds):
        alone = paced_ns(writer, 100)
        sleeper.go(0.4)
        found.setdefault(f"wake-up, {size} B", []).append(paced_ns(writer, 100) - alone)
        sleeper.result()
        for name, core in ((OTHER, kernels[-1]), (SAME, kernels[1])):
            command = [kernels[0], "100", kernels[1], core]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            quiet, asleep = map(int, done.stdout.split())
            found.setdefault(f"{name}, beside {size} B", []).append(asleep - quiet)
    sleeper.end()


def report(
    cost: dict[str, list[float]], late: dict[tuple[int, str], list[float]], words: str
) -> list[str]:
    """Return the tables as Markdown."""
    lines = [
        "# Links between subsystems",
        "",
        f"    {words}",
        "",
        f"{rtbench.machine()}.",
        "",
    ]
    lines += ["| cost to the writer | ns, median | ± |", "|---|---|---|"]
    middle = {name: statistics.median(values) for name, values in cost.items()}
    for name, values in cost.items():
        quarter, _, three = statistics.quantiles(values, n=4)
        lines.append(f"| {name} | {middle[name]:.0f} | {(three - quarter) / 2:.0f} |")
    lines += [
        "",
        "| latency in microseconds | p50 | p99 | records |",
        "|---|---|---|---|",
    ]
    median: dict[tuple[int, str], float] = {}
    for (size, name), values in late.items():
        cuts = statistics.quantiles(values, n=100)
        median[size, name] = cuts[49]
        row = f"| {name}, {size} B | {cuts[49]:.0f} | {cuts[98]:.0f} | {len(values)} |"
        lines.append(row)
    lines.append("")
    goals = {
        f"a write with a local reader at most {MOST_NS:.0f} ns": (
            max(middle[f"write, local reader, {size} B"] for size in SIZES),
            MOST_NS,
        ),
        f"a wake-up at most {WAKE_NS:.0f} ns": (
            max(middle[f"wake-up, {size} B"] for size in SIZES),
            WAKE_NS,
        ),
    }
    text = f"a wake-up at most {SLOWEST:g} x the kernel's own"
    ratios = [
        ours / bare
        for size in SIZES
        for ours, bare in zip(
            cost[f"wake-up, {size} B"], cost[f"{OTHER}, beside {size} B"], strict=True
        )
    ]
    goals[text] = statistics.median(ratios), SLOWEST
    for size in SIZES:
        ratio = median[size, "pbonet"] / median[size, "raw zenoh"]
        goals[f"median latency, {size} B, at most {SLOWEST:g} x raw zenoh"] = (
            ratio,
            SLOWEST,
        )
    for text, (got, most) in goals.items():
        met = "met" if got <= most else "NOT met"
        lines.append(f"- {text}: {got:.3g}, **{met}**")
    return lines


def main() -> None:
    """Run the benchmark and print its tables; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Links beside raw zenoh.")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--markdown", type=Path, help="also write the tables there")
    options = parser.parse_args()
    words = f"python -m benchmarks.tbuf --rounds {options.rounds}"
    words += f" --seconds {options.seconds:g}"
    cost = costs(options.rounds)
    lines = report(cost, latencies(options.rounds, options.seconds), words)
    rtbench.judge(lines, options.markdown)


if __name__ == "__main__":
    main()
