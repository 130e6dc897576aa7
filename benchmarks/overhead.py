"""CPU time per cycle beyond the module's own code, for 1, 4, 16 and 64 tasks on a core.

Every task has an empty ``cycle``, six inputs and six outputs of six numbers, and a
ring; so whatever it costs is overhead: the dispatcher's turn, its level changes, two
switches, copies, guards, accounting, the record. Figures are the kernel's own
(schedstat of the threads), which count the timer interrupt too; the rival is a C loop
on clock_nanosleep, which does nothing else and takes turns with the tasks, block by
block, since what a wake-up costs depends on what else the machine does. "as many": as
many C loops as tasks, each a process with the period of one of them. "together": all
tasks have one period, so that one turn releases them all; "apart": every task has a
period of its own.

With ``--checks`` the same tasks are measured in turns without and with everything that
is looked after: MAXC and MINC declared, a handler with a criticality of its own.
Status 3: a goal was missed.

    python -m benchmarks.overhead [--seconds 1] [--blocks 5] [--checks] [--core 1]
        [--rate 1000] [--counts 1 4 16 64] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks import rtbench
from pbonet.node import rt

if TYPE_CHECKING:
    from collections.abc import Iterator


GOALS = {"together": 1.2, "apart": 1.5}
"""Of the C loop's CPU time, the median of the blocks' ratios, whatever is looked after.

"together" is judged for one task; of several that share their releases each costs less.
"""


class Rig(NamedTuple):
    """What is measured with."""

    core: rt.CoreTable
    dispatcher: rt.Dispatcher
    loop: Path
    level: int
    rate: int
    cycles: int

    def c_loops(self, periods: list[int]) -> float:
        """Return microseconds a cycle of C loops with these periods, all at a time."""
        cycles = -(-self.cycles // len(periods))

        def run(period: int) -> rtbench.Loop:
            return rtbench.run_loop(
                self.loop, self.core.core, self.level, period, cycles
            )

        with ThreadPoolExecutor(len(periods)) as pool:
            spent = sum(loop.cpu_ns for loop in pool.map(run, periods))
        return spent / cycles / len(periods) / 1e3


class Load(NamedTuple):
    """Tasks that run."""

    core: rt.CoreTable
    tasks: list[tuple[int, int, int, rt.Ring]]
    """Slot, pid, period and ring of each."""


def start(
    core: rt.CoreTable, tables: rtbench.Tables, count: int, rate: int, *, apart: bool
) -> Load:
    """Start `count` tasks with `rate` releases a second in all.

    They run while a dispatcher leads.
    """
    load = Load(core, [])
    base = int(1e9 * count / rate)
    for k in range(count):
        slot = core.alloc("bench", f"overhead{k}")
        period = base + (7919 * k * base // (count * 100_000) if apart else 0)
        core.configure(slot, period_ns=period, crit=5, priority=k)
        ring = rt.Ring.create(f"overhead{k}", 1 << 22)

        def body(end: rt.Slot, k: int = k) -> None:
            end.run(
                lambda _dt: None,
                tables.local(k),
                ring=rt.Ring.attach(f"overhead{k}"),  # a fork does not inherit it
                failing=lambda _kind: rt.CONTINUE,
            )

        load.tasks.append((slot, rtbench.start_task(core, slot, body), period, ring))
    return load


def settle(load: Load) -> None:
    """Wait until every task has run some cycles under this dispatcher."""
    before = {slot: load.core.snapshot(slot).cycles for slot, *_ in load.tasks}
    rtbench.wait_for(
        lambda: all(
            load.core.snapshot(slot).cycles >= count + 10
            for slot, count in before.items()
        ),
        "every task runs",
        30.0,
    )


def end(load: Load) -> None:
    """End them."""
    for slot, pid, _, ring in load.tasks:
        rtbench.end_task(load.core, slot, pid)
        ring.destroy()


def totals(load: Load) -> dict[str, float]:
    """Return sums over the tasks, and the dispatcher's counters."""
    status = load.core.status()
    slots = [load.core.snapshot(slot) for slot, *_ in load.tasks]
    return {
        "task": sum(rtbench.thread_cpu_ns(pid) for _, pid, *_ in load.tasks),
        "accounted": sum(slot.cpu_total_ns for slot in slots),
        "cycles": sum(slot.cycles for slot in slots),
        "missed": sum(slot.missed for slot in slots),
        "failures": sum(sum(slot.failures) for slot in slots),
        "dispatcher": load.core.cpu_ns(),
        "turns": status.turns,
        "levels": status.level_changes,
        "now": time.monotonic_ns(),
    }


def block(rig: Rig, load: Load, *, checks: bool) -> dict[str, float]:
    """Return microseconds per cycle, beside the C loop's just before."""
    periods = [period for *_, period, _ in load.tasks]
    c_loop = rig.c_loops([int(1e9 / rig.rate)])
    c_loops = rig.c_loops(periods) if len(periods) > 1 else c_loop
    for slot, _, period, _ in load.tasks:
        rtbench.watch(load.core, slot, period, on=checks)
    rig.dispatcher.start()
    settle(load)
    before = totals(load)
    wanted = before["cycles"] + rig.cycles
    rtbench.wait_for(
        lambda: totals(load)["cycles"] >= wanted,
        "cycles",
        10 + 4 * rig.cycles / rig.rate,
    )
    after = totals(load)
    rig.dispatcher.stop()
    run = after["cycles"] - before["cycles"]
    cost = {key: (after[key] - before[key]) / run for key in after}
    total = (cost["task"] + cost["dispatcher"]) / 1e3
    return {
        "c loop": c_loop,
        "c loops": c_loops,
        "ratio": total / c_loop,
        "task": cost["task"] / 1e3,
        "accounted": cost["accounted"] / 1e3,
        "dispatcher": cost["dispatcher"] / 1e3,
        "total": total,
        "share": 100 * cost["dispatcher"] / cost["now"],
        "turns": cost["turns"],
        "levels": cost["levels"],
        "missed": after["missed"] - before["missed"],
        "failures": after["failures"] - before["failures"],
        "cycles": run,
    }


HEAD = (
    "tasks releases checks C loop us  as many   task us (accounted) dispatcher us"
    "   core %      total us [least greatest]   total / C loop            turns/cycle"
    " levels/cycle missed failures"
)


def line(name: str, blocks: list[dict[str, float]]) -> str:
    """Return a line of the table: medians of the blocks."""
    m = {key: statistics.median(b[key] for b in blocks) for key in blocks[0]}
    return (
        f"{name:21} {m['c loop']:9.1f} {m['c loops']:8.1f} "
        f"{m['task']:9.1f} {m['accounted']:11.1f} {m['dispatcher']:13.1f} "
        f"{m['share']:8.2f} {rtbench.spread([b['total'] for b in blocks], 1)} "
        f"{rtbench.spread([b['ratio'] for b in blocks], 2)} "
        f"{m['turns']:13.3f} {m['levels']:12.3f} "
        f"{sum(b['missed'] for b in blocks):6.0f} "
        f"{sum(b['failures'] for b in blocks):8.0f}"
    )


def measure(
    rig: Rig, tables: rtbench.Tables, args: argparse.Namespace
) -> dict[str, list[dict[str, float]]]:
    """Print a line for each number of tasks; return the blocks."""
    found: dict[str, list[dict[str, float]]] = {}
    for apart in (False, True):
        for count in args.counts:
            if apart and count == 1:
                continue
            load = start(rig.core, tables, count, args.rate, apart=apart)
            modes = (False, True) if args.checks else (False,)
            blocks: dict[bool, list[dict[str, float]]] = {mode: [] for mode in modes}
            for _ in range(args.blocks):
                for mode in modes:
                    blocks[mode].append(block(rig, load, checks=mode))
            end(load)
            for mode in modes:
                how = "apart" if apart else "together"
                name = f"{count:5} {how:8} {'all' if mode else 'none':6}"
                found[" ".join(name.split())] = blocks[mode]
                print(line(name, blocks[mode]), flush=True)
    return found


def goals(found: dict[str, list[dict[str, float]]]) -> Iterator[str]:
    """Yield a line for each goal."""
    for name, blocks in found.items():
        count, how, checks = name.split()
        if how == "together" and count != "1":
            continue
        ratio = statistics.median(block["ratio"] for block in blocks)
        what = f"{count} {how}, checks {checks}: CPU time / C loop"
        yield rtbench.verdict(what, ratio, GOALS[how])


def arguments() -> argparse.Namespace:
    """Return what the command line says."""
    parser = argparse.ArgumentParser(description="Overhead per cycle.")
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--blocks", type=int, default=5)
    parser.add_argument("--checks", action="store_true")
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--rate", type=int, default=1000)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    args = arguments()
    core, tables = rt.CoreTable(args.core), rtbench.Tables(max(args.counts))
    dispatcher = rt.Dispatcher(core)
    level = rtbench.LEVEL if dispatcher.backend == "fifo" else 0
    cycles = int(args.rate * args.seconds)
    print(rtbench.machine())
    print(f"back end {dispatcher.backend}, {args.rate} cycles a second in all")
    print(HEAD)
    try:
        with tempfile.TemporaryDirectory() as folder:
            loop = rtbench.compile_c("clockloop", Path(folder))
            rig = Rig(core, dispatcher, loop, level, args.rate, cycles)
            found = measure(rig, tables, args)
    finally:
        dispatcher.stop()
        core.close()
        tables.table.destroy()
    if args.json:
        told = {"machine": rtbench.machine(), **found}
        args.json.write_text(json.dumps(told, indent=1), encoding="utf-8")
    rtbench.judge(goals(found))


if __name__ == "__main__":
    main()
