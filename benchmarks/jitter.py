"""Release jitter of one 1 kHz task, beside a C loop on clock_nanosleep.

Both stand at the same SCHED_FIFO level on the same core and take turns, block by block,
so that whatever else the machine does hits both alike. The task reads the clock in the
first line of its ``cycle``; it copies its inputs in before and its outputs out after,
from a real table. Given are the quantiles of each block, and the median and spread of
the ratios of neighbouring blocks.

    python benchmarks/jitter.py [--blocks 7] [--seconds 4] [--core 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from pbonet.node import _rt

QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
LEVEL = 44
"""What a task alone on its core gets (`pbonet.sched.urgency.assign_levels`)."""


def compile_loop(folder: Path) -> Path:
    """Return the compiled C loop."""
    program = folder / "clockloop"
    source = Path(__file__).with_name("clockloop.c")
    subprocess.run(["cc", "-O2", "-o", program, source], check=True)
    return program


def run_loop(program: Path, core: int, level: int, period: int, cycles: int):
    """Return the C loop's delays in nanoseconds."""
    done = subprocess.run(
        [program, str(core), str(level), str(period), str(cycles)],
        check=True,
        capture_output=True,
    )
    return np.fromstring(done.stdout.decode(), dtype=np.int64, sep="\n")


def run_task(table: _rt.CoreTable, core: int, period: int, cycles: int, local_of):
    """Return a pbonet task's delays in nanoseconds; the task is a process of its own."""
    slot = table.alloc("bench", "jitter")
    table.configure(slot, period_ns=period, crit=5)
    out = np.memmap(
        tempfile.TemporaryFile(), dtype=np.int64, mode="w+", shape=(cycles + 1,)
    )
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            task_main(table, slot, core, cycles, out, local_of)
            status = 0
        finally:
            os._exit(status)
    table.configure(slot, pid=pid)
    deadline = time.monotonic() + 5 + cycles * period * 2e-9
    while out[cycles] == 0 and time.monotonic() < deadline:
        time.sleep(0.05)
    table.request(slot)
    _, status = os.waitpid(pid, 0)
    table.died(slot)
    missed = table.snapshot(slot).missed
    table.free(slot)
    if status or not out[cycles]:
        sys.exit(f"the task failed ({status})")
    return np.array(out[:cycles]), missed


def task_main(table, slot_index, core, cycles, out, local_of) -> None:
    """Set the process up as a task's is, and run cycles."""
    _rt.orphan_guard(signal.SIGUSR1, os.getppid())
    _rt.lock_memory()
    _rt.populate_pages()
    _rt.prefault_stack()
    _rt.set_timer_slack()
    _rt.pin(core)
    slot = _rt.Slot(table, slot_index)
    local = local_of()
    now, delays, count = time.monotonic_ns, [0] * (cycles + 1), 0

    def cycle(_dt: float) -> None:
        nonlocal count
        delays[count] = now() - slot.release_ns
        if count < cycles:
            count += 1
        elif not out[cycles]:
            out[:cycles] = delays[:cycles]
            out[cycles] = 1

    gc.collect()
    gc.freeze()
    gc.disable()
    slot.run(cycle, local)
    slot.disarm()


def quantiles(delays) -> dict[str, float]:
    """Return the quantiles in microseconds."""
    return {name: float(np.quantile(delays, q)) / 1e3 for name, q in QUANTILES.items()}


def machine() -> dict[str, object]:
    """Say where this was measured."""
    model = next(
        (
            line.split(":")[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        platform.machine(),
    )
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "kernel": platform.release() + " " + _rt.probe().preempt,
        "python": platform.python_version(),
        "load": os.getloadavg(),
    }


def local_maker():
    """Return what gives the task a local table: 6 inputs and 6 outputs of 6 doubles."""
    from pbonet.config.model import Variable
    from pbonet.svar import Table

    names = [f"{kind}{k}" for kind in "IO" for k in range(6)]
    variables = [Variable(name=name, type="double", nelem=6) for name in names]
    table = Table.create(f"jitter{os.getpid()}", variables)

    def make():
        local = table.local("jitter", os.getpid(), invar=names[:6], outvar=names[6:])
        local.claim()
        return local

    return table, make


def report(blocks, missed) -> dict[str, object]:
    """Print the table and return it."""
    result: dict[str, object] = {"machine": machine(), "missed": missed}
    print(f"{'':6} {'C loop, us':>28} {'pbonet, us':>28} {'ratio':>22}")
    for name in QUANTILES:
        c = [loop[name] for loop, _ in blocks]
        p = [task[name] for _, task in blocks]
        ratios = [b / a for a, b in zip(c, p, strict=True)]
        middle = statistics.median(ratios)
        result[name] = {"c": c, "pbonet": p, "ratios": ratios, "median": middle}
        print(
            f"{name:6} {statistics.median(c):10.1f} [{min(c):6.1f} {max(c):8.1f}]"
            f" {statistics.median(p):10.1f} [{min(p):6.1f} {max(p):8.1f}]"
            f" {middle:8.2f} [{min(ratios):5.2f} {max(ratios):5.2f}]"
        )
    return result


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--period-us", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    period = args.period_us * 1000
    cycles = int(args.seconds * 1e9 / period)
    core = _rt.CoreTable(args.core)
    dispatcher = _rt.Dispatcher(core)
    level = LEVEL if dispatcher.backend == "fifo" else 0
    svar, make_local = local_maker()
    blocks, missed = [], 0
    try:
        with tempfile.TemporaryDirectory() as folder:
            loop = compile_loop(Path(folder))
            for _ in range(args.blocks):
                c = run_loop(loop, args.core, level, period, cycles)
                dispatcher.start()
                p, lost = run_task(core, args.core, period, cycles, make_local)
                dispatcher.stop()
                missed += lost
                blocks.append((quantiles(c), quantiles(p)))
    finally:
        dispatcher.stop()
        core.close()
        svar.destroy()
    print(
        f"back end {dispatcher.backend}, {args.blocks} blocks of {cycles} cycles each,"
        f" {missed} releases missed"
    )
    result = report(blocks, missed)
    if args.json:
        args.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
