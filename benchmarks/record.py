"""What recording costs: a task, the recorder, the disk; and how fast a log is verified.

* CPU time that the record of each cycle adds to a 1 kHz task of six inputs and six
  outputs, in turns without a ring, with one, and with the inputs of every cycle.
* CPU time of the recorder for 20 tasks of 1 kHz with six numbers each, fed through
  their rings at that rate, and bytes on disk per sample: random walks, without what a
  cycle has read.
* Time to open a log of a size, to read one of its 20 tasks, and to open it cut short.
* The PUMA example is run for some seconds and verified, task by task.

    python -m benchmarks.record [--seconds 2] [--blocks 5] [--core 1] [--megabytes 1000]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from benchmarks import rtbench
from pbonet.config.model import Variable
from pbonet.log import Log, LogWriter, RunAbout, TaskAbout, last_run
from pbonet.log.schema import HEAD_DTYPE, RECORD
from pbonet.node import _rt, wire
from pbonet.testing import verify

if TYPE_CHECKING:
    from collections.abc import Sequence

PERIOD = 1_000_000
TASKS = 20
PUMA = Path(__file__).parents[1] / "examples" / "puma" / "puma.job"
WAYS = ("no ring", "outputs", "all")


def cycle_cost(
    core: _rt.CoreTable, tables: rtbench.Tables, way: str, seconds: float
) -> float:
    """Return the CPU microseconds of a cycle of an empty module."""
    slot = core.alloc("bench", "record")
    core.configure(slot, period_ns=PERIOD, crit=5)
    ring = None if way == "no ring" else _rt.Ring.create("record", 1 << 24)
    if ring is not None and way == "all":
        ring.want(always=True)

    def body(end: _rt.Slot) -> None:
        end.run(lambda _dt: None, tables.local(0), ring=ring)

    pid = rtbench.start_task(core, slot, body)
    rtbench.wait_for(lambda: core.snapshot(slot).cycles > 20, "cycles", 10.0)
    first, spent = core.snapshot(slot).cycles, rtbench.thread_cpu_ns(pid)
    time.sleep(seconds)
    cycles = core.snapshot(slot).cycles - first
    spent = rtbench.thread_cpu_ns(pid) - spent
    rtbench.end_task(core, slot, pid)
    if ring is not None:
        ring.destroy()
    return spent / cycles * 1e-3


def costs(core_number: int, seconds: float, blocks: int) -> dict[str, list[float]]:
    """Return the cost of a cycle, block by block, for each way."""
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    core = _rt.CoreTable(core_number, member=True)
    dispatcher = _rt.Dispatcher(core, "auto")
    dispatcher.start()
    tables = rtbench.Tables(1, arrays=1)
    try:
        for _ in range(blocks):
            for way in WAYS:
                found[way].append(cycle_cost(core, tables, way, seconds))
    finally:
        dispatcher.stop()
        tables.table.destroy()
        core.close()
    return found


def feed(rings: Sequence[_rt.Ring], walks: Any, seconds: float) -> int:  # noqa: ANN401
    """Put records into the rings at 1 kHz each, in real time; return how many."""
    begun, sent = time.monotonic_ns(), 0
    while (now := time.monotonic_ns() - begun) < seconds * 1e9:
        while sent * PERIOD < now:
            data = walks[sent % len(walks)]
            stamp = begun + sent * PERIOD
            for k, ring in enumerate(rings):
                ring.put(
                    data[k].tobytes(),
                    cycle=sent + 1,
                    now_ns=stamp,
                    uid=k + 1,
                    number=sent,
                )
            sent += 1
        time.sleep(0.01)
    return sent * len(rings)


def recorder(core: int, seconds: float) -> dict[str, float]:
    """Return what the recorder took, in all and for each sample."""
    random = np.random.default_rng(1)
    walks = random.normal(size=(4000, TASKS, 6)).cumsum(axis=0)
    out = [Variable(name="Y", type="double", nelem=6, units="rad")]
    with tempfile.TemporaryDirectory() as folder:
        names = [f"bench.rec.t{k}" for k in range(TASKS)]
        rings: list[_rt.Ring] = []
        for k, name in enumerate(names):
            about = _about(f"t{k}", out)
            rings.append(_rt.Ring.create(name, about=msgspec.json.encode(about)))
        wanted = wire.Recording(
            domain="bench",
            rtpu="r0",
            subsystem="rec",
            core=core,
            folder=folder,
            file="run",
            run="bench",
            job="bench",
            mode="outputs",
        )
        memory = os.memfd_create("recording")
        os.write(memory, wire.encode(wanted))
        process = subprocess.Popen(
            [sys.executable, "-m", "pbonet.node.recorder", str(memory)],
            pass_fds=[memory],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
        )
        path = Path(folder, "run.mcap")
        rtbench.wait_for(path.exists, "the log", 10.0)
        spent = rtbench.thread_cpu_ns(process.pid)
        samples = feed(rings, walks, seconds)
        spent = rtbench.thread_cpu_ns(process.pid) - spent
        lost = sum(ring.lost for ring in rings)
        process.communicate()
        for ring in rings:
            ring.destroy()
        log = Log(path)
        kept = sum(len(log.arrays(task)["cycle"]) for task in log.tasks)
        return {
            "samples": samples,
            "on record": kept,
            "lost": lost,
            "share of a core": spent / (seconds * 1e9),
            "CPU us a sample": spent / samples * 1e-3,
            "bytes a sample": path.stat().st_size / samples,
        }


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
        begun = time.perf_counter()
        Log(cut)
        found["s to open it cut"] = time.perf_counter() - begun
        return found


_RUN = RunAbout(run="bench", job="bench", subsystem="rec", domain="bench", rtpu="r0")


def _records(seed: int, count: int) -> bytes:
    """Return records as a ring has them, of random walks."""
    walks = np.random.default_rng(seed).normal(size=(count, 6)).cumsum(axis=0)
    heads = np.zeros(count, HEAD_DTYPE)
    heads["release_ns"] = heads["end_ns"] = np.arange(count) * PERIOD
    heads["cycle"] = np.arange(count) + 1
    size = RECORD.size + HEAD_DTYPE.itemsize + walks[0].nbytes
    head = RECORD.pack(size, 0, walks[0].nbytes, 0)
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


def verified(seconds: float) -> list[dict[str, Any]]:
    """Run the PUMA example, and verify it; return figures by task."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pbonet.cli", "run", str(PUMA)]
        command += ["--seconds", f"{seconds:g}", "--runs", folder]
        command += ["--domain", f"record{os.getpid()}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        log = Log(last_run(folder))
        rows: list[dict[str, Any]] = []
        for one in verify(log):
            cpu = log.arrays(one.task)["cpu_ns"].mean() * 1e-3
            rows.append({
                "task": one.task,
                "identical": one.cycles,
                "recorded": one.recorded,
                "x real time": one.seconds / one.took,
                "us a cycle": one.took / max(one.cycles, 1) * 1e6,
                "CPU us a cycle in the task": float(cpu),
            })
        return rows


def main() -> None:
    """Measure, and print."""
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
    for way in WAYS[1:]:
        pairs = zip(found[way], found["no ring"], strict=True)
        added = [one - none for one, none in pairs]
        print(f"{way:12} adds {statistics.median(added):.2f}")
    took = {"recorder": recorder(told.core, 5.0 * told.seconds)}
    print(f"\nrecorder, {TASKS} tasks of 1 kHz and 6 numbers")
    for name, value in took["recorder"].items():
        print(f"{name:18} {value:12.4g}")
    took["opening"] = opening(told.megabytes)
    print("\nreading a log")
    for name, value in took["opening"].items():
        print(f"{name:22} {value:12.4g}")
    rows = verified(5.0)
    print("\nverified:")
    for row in rows:
        print("  ".join(f"{k} {v:.4g}" if k != "task" else v for k, v in row.items()))
    if told.json:
        data = {"cycle": found, **took, "verify": rows}
        told.json.write_text(json.dumps(data), encoding="utf-8")


if __name__ == "__main__":
    main()
