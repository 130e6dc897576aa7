"""CPU time per cycle beyond the module's own code, for 1, 4, 16 and 64 tasks on a core.

Every task has an empty ``cycle``, six inputs and six outputs of six numbers, and a
ring; so whatever it costs is overhead: the dispatcher's turn, its level changes, two
switches, copies, guards, accounting, the record. Figures are the kernel's own
(schedstat of the threads), which count the timer interrupt too; the rival is a C loop
on clock_nanosleep, which does nothing else. "together": all tasks have one period, so
that one turn releases them all; "apart": every task has a period of its own.

    python -m benchmarks.overhead [--seconds 3] [--core 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from benchmarks import rtbench
from pbonet.node import _rt

COUNTS = (1, 4, 16, 64)
RATE = 2000
"""Cycles a second of all tasks together; 64 tasks then have 31 Hz each."""


def measure(
    core: _rt.CoreTable,
    tables: rtbench.Tables,
    count: int,
    seconds: float,
    *,
    apart: bool,
) -> dict[str, float]:
    """Return microseconds per cycle for `count` tasks."""
    tasks: list[tuple[int, int, _rt.Ring]] = []
    base = int(1e9 * count / RATE)
    for k in range(count):
        slot = core.alloc("bench", f"overhead{k}")
        period = base + (7919 * k * base // (count * 100_000) if apart else 0)
        core.configure(slot, period_ns=period, crit=5, priority=k)
        ring = _rt.Ring.create(f"overhead{k}", 1 << 22)

        def body(end: _rt.Slot, k: int = k, ring: _rt.Ring = ring) -> None:
            end.run(lambda _dt: None, tables.local(k), ring=ring)

        tasks.append((slot, rtbench.start_task(core, slot, body), ring))
    slots = [slot for slot, _, _ in tasks]
    rtbench.wait_for(
        lambda: all(core.snapshot(slot).cycles >= 10 for slot in slots),
        "every task runs",
        30.0,
    )
    before = totals(core, tasks)
    wanted = before["cycles"] + RATE * seconds
    rtbench.wait_for(
        lambda: totals(core, tasks)["cycles"] >= wanted, "cycles", 10 + 4 * seconds
    )
    after = totals(core, tasks)
    for slot, pid, ring in tasks:
        rtbench.end_task(core, slot, pid)
        ring.destroy()
    cycles = after["cycles"] - before["cycles"]
    cost = {key: (after[key] - before[key]) / cycles for key in after}
    return {
        "task": cost["task"] / 1e3,
        "accounted": cost["accounted"] / 1e3,
        "dispatcher": cost["dispatcher"] / 1e3,
        "total": (cost["task"] + cost["dispatcher"]) / 1e3,
        "turns": cost["turns"],
        "levels": cost["levels"],
        "missed": after["missed"] - before["missed"],
        "cycles": cycles,
    }


def totals(
    core: _rt.CoreTable, tasks: list[tuple[int, int, _rt.Ring]]
) -> dict[str, float]:
    """Return sums over the tasks, and the dispatcher's counters."""
    status = core.status()
    slots = [core.snapshot(slot) for slot, _, _ in tasks]
    return {
        "task": sum(rtbench.thread_cpu_ns(pid) for _, pid, _ in tasks),
        "accounted": sum(slot.cpu_total_ns for slot in slots),
        "cycles": sum(slot.cycles for slot in slots),
        "missed": sum(slot.missed for slot in slots),
        "dispatcher": status.cpu_ns,
        "turns": status.turns,
        "levels": status.level_changes,
    }


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Overhead per cycle.")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    core, tables = _rt.CoreTable(args.core), rtbench.Tables(max(COUNTS))
    dispatcher = _rt.Dispatcher(core)
    level = rtbench.LEVEL if dispatcher.backend == "fifo" else 0
    cycles = int(RATE * args.seconds)
    result: dict[str, object] = {"machine": rtbench.machine()}
    try:
        with tempfile.TemporaryDirectory() as folder:
            loop = rtbench.compile_loop(Path(folder))
            c = rtbench.run_loop(loop, args.core, level, int(1e9 / RATE), cycles)
        result["c_loop"] = c.cpu_ns / cycles / 1e3
        print(rtbench.machine())
        print(
            f"back end {dispatcher.backend}, {RATE} cycles a second in all; C loop "
            f"{c.cpu_ns / cycles / 1e3:.1f} us a cycle"
        )
        print(
            "tasks releases   task us  (accounted)  dispatcher us  total us  "
            "turns/cycle  level changes/cycle  missed"
        )
        dispatcher.start()
        for apart in (False, True):
            for count in COUNTS:
                got = measure(core, tables, count, args.seconds, apart=apart)
                how = "apart" if apart else "together"
                result[f"{count} {how}"] = got
                print(
                    f"{count:5} {how:8} {got['task']:9.1f} {got['accounted']:12.1f} "
                    f"{got['dispatcher']:14.1f} {got['total']:9.1f} "
                    f"{got['turns']:12.3f} {got['levels']:20.3f} {got['missed']:7.0f}"
                )
    finally:
        dispatcher.stop()
        core.close()
        tables.table.destroy()
    if args.json:
        args.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
