"""What recording costs: a task, the recorder, the disk; and how fast logs are read.

* CPU time that the record of each cycle adds to a 1 kHz task of six inputs and six
  outputs, in turns without a ring, with one, and with the inputs of every cycle; a
  recorder empties the rings all the while.
* CPU time of the recorder for 20 tasks of 1 kHz in a line, each reading the six numbers
  of the one before it and writing six of its own, random walks; bytes on disk a sample.
* Time to open a log of a size, to read one of its 20 tasks, and to open it cut short.
* The PUMA example is run for some seconds; each task is verified, and the servo played
  into a table, as fast as that goes and at its own times.

    python -m benchmarks.record [--seconds 2] [--blocks 5] [--core 1] [--megabytes 1000]

Status 3: a goal was missed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from benchmarks import rtbench
from pbonet.config.model import Variable
from pbonet.log import Log, LogWriter, RunAbout, TaskAbout, last_run, scan
from pbonet.log.cycle_columns import HEAD_DTYPE
from pbonet.log.schema import RECORD
from pbonet.master.tools.playback import Span, play
from pbonet.node import rt
from pbonet.node.wire import rtpu_messages
from pbonet.svar import Table
from pbonet.testing import verify

if TYPE_CHECKING:
    from collections.abc import Generator

    from numpy.typing import NDArray

PERIOD = 1_000_000
TASKS = 20
PUMA = Path(__file__).parents[1] / "examples" / "puma" / "puma.job"
SERVO = "puma_pidg"
WAYS = ("none", "outputs", "all")
MISSED = 3
CHUNKS = 200
MOST_ADDED, MOST_CORE, MOST_BYTES, MOST_OPEN, LEAST_SPEED = 0.5, 0.04, 60.0, 1.0, 60.0
"""Goals: us a cycle, share of a core, bytes a sample, s to open a log, x real time of
the servo."""


@contextlib.contextmanager
def recording(core: int, folder: str) -> Generator[subprocess.Popen[bytes]]:
    """Have a recorder follow the rings of subsystem ``rec``, and finish its log."""
    wanted = rtpu_messages.Recording(
        domain="bench",
        rtpu="r0",
        subsystem="rec",
        core=core,
        folder=folder,
        file="run",
        run="bench",
        job="bench",
        mode="outputs",
        tasks={"all": "all"},
    )
    memory = os.memfd_create("recording")
    os.write(memory, rtpu_messages.encode(wanted))
    process = subprocess.Popen(
        [sys.executable, "-m", "pbonet.node.recorder.recorder_process", str(memory)],
        pass_fds=[memory],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    try:
        rtbench.wait_for(Path(folder, "run.mcap").exists, "the log", 10.0)
        yield process
    finally:
        process.communicate()
        os.close(memory)


def cycle_cost(
    core: rt.CoreTable, tables: rtbench.Tables, way: str, seconds: float
) -> float:
    """Return the CPU microseconds of a cycle of an empty module."""
    slot = core.alloc("bench", "record")
    core.configure(slot, period_ns=PERIOD, crit=5)
    ring = None
    if way != "none":
        out = [Variable(name="O0_0", type="double", nelem=6)]
        about = msgspec.json.encode(_about(way, out))
        ring = rt.Ring.create(f"bench.rec.{way}", 1 << 20, about)

    def body(end: rt.Slot) -> None:
        own = None if ring is None else rt.Ring.attach(ring.name)
        end.run(lambda _dt: None, tables.local(0), ring=own)

    pid = rtbench.start_task(core, slot, body)
    rtbench.wait_for(lambda: core.snapshot(slot).cycles > 200, "cycles", 10.0)
    first, spent = core.snapshot(slot).cycles, rtbench.thread_cpu_ns(pid)
    time.sleep(seconds)
    cycles = core.snapshot(slot).cycles - first
    spent = rtbench.thread_cpu_ns(pid) - spent
    rtbench.end_task(core, slot, pid)
    if ring is not None:
        assert not ring.lost, "nobody has emptied the ring"
        ring.destroy()
    return spent / cycles * 1e-3


def costs(core_number: int, seconds: float, blocks: int) -> dict[str, list[float]]:
    """Return the cost of a cycle, block by block, for each way."""
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    with _dispatched(core_number) as core, tempfile.TemporaryDirectory() as folder:
        tables = rtbench.Tables(1, arrays=1)
        try:
            with recording(core_number, folder):
                for _ in range(blocks):
                    for way in WAYS:
                        found[way].append(cycle_cost(core, tables, way, seconds))
        finally:
            tables.table.destroy()
    return found


@contextlib.contextmanager
def _dispatched(core_number: int) -> Generator[rt.CoreTable]:
    """Have tasks of a core released."""
    core = rt.CoreTable(core_number, member=True)
    dispatcher = rt.Dispatcher(core, "auto")
    dispatcher.start()
    try:
        yield core
    finally:
        dispatcher.stop()
        core.close()


def _walk(table: str, number: int, ring: str, walk: NDArray[np.float64]) -> Any:  # noqa: ANN401 - what a process does
    """Return what a task does that reads the one before it and walks at random."""

    def body(end: rt.Slot) -> None:
        names = [f"Y{(number - 1) % TASKS}"], [f"Y{number}"]
        local = Table.attach(table).local(  # a fork has none of the memory
            f"t{number}", os.getpid(), invar=names[0], outvar=names[1]
        )
        local.claim()
        out, steps = local.array(f"Y{number}"), iter(range(1 << 62))

        def cycle(_dt: float) -> None:
            out[:] = walk[next(steps) % len(walk)]

        end.run(cycle, local, ring=rt.Ring.attach(ring))

    return body


def recorder(core_number: int, seconds: float) -> dict[str, float]:
    """Return what the recorder took, in all and for each sample."""
    random = np.random.default_rng(1)
    walks = random.normal(size=(TASKS, 4000, 6)).cumsum(axis=1)
    outs = [Variable(name=f"Y{k}", type="double", nelem=6) for k in range(TASKS)]
    table = Table.create(f"bench{os.getpid()}", outs)
    rings = [
        rt.Ring.create(
            f"bench.rec.t{k}", 1 << 20, msgspec.json.encode(_about(f"t{k}", [out]))
        )
        for k, out in enumerate(outs)
    ]
    try:
        with (
            _dispatched(core_number) as core,
            tempfile.TemporaryDirectory() as folder,
        ):
            with recording(core_number, folder) as process:
                running: list[tuple[int, int]] = []
                for k, ring in enumerate(rings):
                    slot = core.alloc("bench/r0", f"rec/t{k}")
                    core.configure(slot, period_ns=PERIOD, crit=5)
                    body = _walk(table.name, k, ring.name, walks[k])
                    running.append((slot, rtbench.start_task(core, slot, body)))
                last = running[-1][0]
                rtbench.wait_for(
                    lambda: core.snapshot(last).cycles > 500, "cycles", 20.0
                )
                first = sum(core.snapshot(slot).cycles for slot, _ in running)
                spent, begun = rtbench.thread_cpu_ns(process.pid), time.monotonic()
                time.sleep(seconds)
                spent = rtbench.thread_cpu_ns(process.pid) - spent
                passed = time.monotonic() - begun
                cycles = [core.snapshot(slot).cycles for slot, _ in running]
                samples = sum(cycles) - first
                for slot, pid in running:
                    rtbench.end_task(core, slot, pid)
                lost = sum(ring.lost for ring in rings)
            path = Path(folder, "run.mcap")
            log = Log(path)
            kept = sum(len(log.arrays(task)["cycle"]) for task in log.tasks)
            return {
                "samples": samples,
                "of which were due": passed * 1e9 / PERIOD * TASKS,
                "lost": lost,
                "share of a core": spent / (passed * 1e9),
                "CPU us a sample": spent / samples * 1e-3,
                "on record, in all": kept,
                "bytes a sample": path.stat().st_size / kept,
            }
    finally:
        for ring in rings:
            ring.destroy()
        table.destroy()


def opening(megabytes: float) -> dict[str, float]:
    """Return what it takes to read a log of that size, finished and cut short."""
    out = [Variable(name="Y", type="double", nelem=6, units="rad")]
    with tempfile.TemporaryDirectory() as folder:
        path, cut = Path(folder, "run.mcap"), Path(folder, "cut.mcap")
        writer = LogWriter(path, _RUN)
        numbers = [writer.add_task(_about(f"t{k}", out)) for k in range(TASKS)]
        data = [_records(k, 1000) for k in range(TASKS)]
        messages, stop = 0, megabytes * 1e6
        while writer.size < stop:
            for number, records in zip(numbers, data, strict=True):
                messages += writer.add(number, records)
        writer.close()
        size = path.stat().st_size
        with path.open("rb") as whole, cut.open("wb") as part:
            while (rest := int(size * 0.99) - part.tell()) > 0:
                part.write(whole.read(min(rest, 1 << 20)))
        found = {"MB": size / 1e6, "messages": float(messages)}
        begun = time.perf_counter()
        log = Log(path)
        found["s to open it"] = time.perf_counter() - begun
        cycles = len(log.arrays("t7")["cycle"])
        found["s to one task's arrays"] = time.perf_counter() - begun
        found["cycles of it"] = cycles
        found["cycles read a second"] = cycles / found["s to one task's arrays"]
        found["share of checksums in unpacking"] = _checksums(path)
        begun = time.perf_counter()
        Log(cut)
        found["s to open it cut"] = time.perf_counter() - begun
        return found


def _checksums(path: Path) -> float:
    """Return which share of the time to unpack chunks their checksums take."""
    whole = sums = 0.0
    with path.open("rb") as file:
        chunks = [
            one for one in scan.scan(file, str(path)).records
            if one.opcode == scan.CHUNK
        ]  # fmt: skip
        for one in chunks[:CHUNKS]:
            file.seek(one.at)
            content = file.read(one.size)
            begun = time.perf_counter()
            data = scan.unpacked(content)
            unpacked = time.perf_counter()
            zlib.crc32(data or b"")
            sums += time.perf_counter() - unpacked
            whole += unpacked - begun
    return sums / whole


_RUN = RunAbout(run="bench", job="bench", subsystem="rec", domain="bench", rtpu="r0")


def _records(seed: int, count: int) -> bytes:
    """Return records as a ring has them, of random walks."""
    walks = np.random.default_rng(seed).normal(size=(count, 6)).cumsum(axis=0)
    heads = np.zeros(count, HEAD_DTYPE)
    heads["release_ns"] = heads["end_ns"] = np.arange(count) * PERIOD
    heads["cycle"] = heads["number"] = np.arange(count) + 1
    heads["dt_ns"], heads["register"] = PERIOD, 1
    size = RECORD.size + HEAD_DTYPE.itemsize + walks[0].nbytes
    head = RECORD.pack(size, 0, walks[0].nbytes, 0, 0, 0)
    return b"".join([
        head + one.tobytes() + walk.tobytes()
        for one, walk in zip(heads, walks, strict=True)
    ])


def _about(task: str, out: list[Variable]) -> TaskAbout:
    return TaskAbout(
        domain="bench",
        rtpu="r0",
        subsystem="rec",
        task=task,
        module="m",
        pid=1,
        freq=1000.0,
        rmod="",
        rmod_name=f"{task}.rmod",
        outvar=out,
    )


def puma(seconds: float, folder: str) -> Log:
    """Run the PUMA example; return its log."""
    command = [sys.executable, "-m", "pbonet.cli", "run", str(PUMA)]
    command += ["--seconds", f"{seconds:g}", "--runs", folder]
    command += ["--domain", f"record{os.getpid()}"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return Log(last_run(folder))


def verified(log: Log) -> list[dict[str, Any]]:
    """Verify a run; return figures by task."""
    rows: list[dict[str, Any]] = []
    for one in verify(log):
        cpu = log.arrays(one.task)["cpu_ns"].mean() * 1e-3
        begun = time.process_time()  # once more, all reading of the log included
        (again,) = verify(log, [one.task])
        spent = time.process_time() - begun
        rows.append({
            "task": one.task,
            "identical": one.cycles,
            "recorded": one.recorded,
            "x real time": one.seconds / one.took,
            "x with loading": one.seconds / (one.took + one.loading),
            "x by CPU time": again.seconds / spent,
            "ms to load": one.loading * 1e3,
            "us a cycle": one.took / max(one.cycles, 1) * 1e6,
            "CPU us a cycle in the task": float(cpu),
        })
    return rows


def played(log: Log) -> dict[str, float]:
    """Play what the servo wrote into a table, as fast as it goes and at its times."""
    about = log.task_about(SERVO)
    table = Table.create("bench.play", [*about.outvar, *about.outconst])
    try:
        begun = time.perf_counter()
        (fast,) = play(
            log.path, [SERVO], Span(rate=1e9), domain="bench", subsystem="play"
        )
        took = time.perf_counter() - begun
        (true,) = play(
            log.path, [SERVO], Span(end=2.0), domain="bench", subsystem="play"
        )
    finally:
        table.destroy()
    seconds = float(np.ptp(log.arrays(SERVO)["release_ns"])) * 1e-9
    return {
        "commits": fast.commits,
        "us a commit, all at once": took / fast.commits * 1e6,
        "x real time at most": seconds / took,
        "ms late at rate 1, the latest": true.late * 1e3,
    }


def main() -> int:
    """Measure, and print; return 3 when a goal is missed."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--seconds", type=float, default=2.0)
    words.add_argument("--blocks", type=int, default=5)
    words.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)))
    words.add_argument("--megabytes", type=float, default=1000.0)
    words.add_argument("--json", type=Path)
    told = words.parse_args()
    print(rtbench.machine())
    found = costs(told.core, told.seconds, told.blocks)
    print("\nCPU us of a cycle at 1 kHz: median [least, greatest] of blocks")
    for way, values in found.items():
        print(f"{way:12} {rtbench.spread(values, 2)}")
    added = {
        way: statistics.median(
            one - none for one, none in zip(found[way], found["none"], strict=True)
        )
        for way in WAYS[1:]
    }
    for way, value in added.items():
        print(f"{way:12} adds {value:.2f}")
    kept = recorder(told.core, 5.0 * told.seconds)
    _table(f"recorder, {TASKS} tasks of 1 kHz and 6 numbers", kept)
    opened = opening(told.megabytes)
    _table("reading a log", opened)
    with tempfile.TemporaryDirectory() as folder:
        log = puma(5.0, folder)
        rows = verified(log)
        speed = played(log)
    print("\nverified:")
    for row in rows:
        print("  ".join(f"{k} {v:.4g}" if k != "task" else v for k, v in row.items()))
    _table(f"{SERVO} played", speed)
    if told.json:
        data = {"cycle": found, "recorder": kept, "opening": opened}
        data |= {"verify": rows, "play": speed}
        told.json.write_text(json.dumps(data), encoding="utf-8")
    goals = _judged(added["outputs"], kept, opened, rows)
    print("\ngoals")
    for text, (got, met) in goals.items():
        print(f"{'met   ' if met else 'MISSED'} {text}: {got:.3g}")
    return 0 if all(met for _, met in goals.values()) else MISSED


def _judged(
    added: float,
    kept: dict[str, float],
    opened: dict[str, float],
    rows: list[dict[str, Any]],
) -> dict[str, tuple[float, bool]]:
    """Return what was asked: what was measured, and whether that is good."""
    servo = next(row["x by CPU time"] for row in rows if row["task"] == SERVO)
    share, opens = kept["share of a core"], opened["s to open it"]
    return {
        f"a record adds at most {MOST_ADDED:g} us a cycle": (
            added,
            added <= MOST_ADDED,
        ),
        f"the recorder takes at most {MOST_CORE:g} of a core, and loses nothing": (
            share,
            share <= MOST_CORE and not kept["lost"],
        ),
        f"a sample takes at most {MOST_BYTES:g} bytes": (
            kept["bytes a sample"],
            kept["bytes a sample"] <= MOST_BYTES,
        ),
        f"a log opens within {MOST_OPEN:g} s": (opens, opens <= MOST_OPEN),
        f"the servo is verified at {LEAST_SPEED:g} x real time by CPU time or more": (
            servo,
            servo >= LEAST_SPEED,
        ),
    }


def _table(title: str, values: dict[str, float]) -> None:
    print(f"\n{title}")
    for name, value in values.items():
        print(f"{name:32} {value:12.4g}")


if __name__ == "__main__":
    sys.exit(main())
