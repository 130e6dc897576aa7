"""What the parts of a turn and of a cycle cost, in nanoseconds.

Ranking ready tasks and handing levels out (sort and assign), one of them with a new
deadline; one sched_setscheduler call, beside it; the accounting of a cycle (goal: 1.5
microseconds); a signal to its handler, in a loop and after a sleep; all timed in C, on
the project's own headers. Then, within the cycles of
a real task, at its level and on its core: `with self.task.critical()`, and `with
self.task.timed(...)`, each beside an empty `with` of a context manager written in
Python, and beside two calls of `time.thread_time_ns`.

    python -m benchmarks.costs [--blocks 11] [--core 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from benchmarks import rtbench
from pbonet.node import rt
from pbonet.node.task.slot_timing import SlotWatch
from pbonet.pbo import TaskContext

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

ROUNDS = 500
"""Sections in a cycle."""
ACCOUNT, MOST_NS = "account a cycle", 1500.0
"""The part that has a goal."""


class Empty:
    """What a module's author would write."""

    def __enter__(self) -> Self:
        """Do nothing."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""


def parts_in_c(core: int, blocks: int) -> dict[str, list[float]]:
    """Return what the C program says, by part."""
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        program = rtbench.compile_c("rtcosts", Path(folder))
        done = subprocess.run(
            [program, str(core), str(blocks)],
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        )
    for line in done.stdout.splitlines():
        name, ns = line.split("\t")
        found.setdefault(name, []).append(float(ns))
    return found


def within(section: Callable[[], AbstractContextManager[object]]) -> None:
    """Enter and leave a section many times."""
    for _ in range(ROUNDS):
        with section():
            pass


def nothing() -> None:
    """Do what `within` does around its sections."""
    for _ in range(ROUNDS):
        pass


def two_clocks() -> None:
    """Time something as one would by hand."""
    clock = time.thread_time_ns
    for _ in range(ROUNDS):
        clock()
        clock()


NAMES = (
    "nothing",
    "with self.task.critical()",
    "with self.task.timed()",
    "an empty with of a Python class",
    "two calls of time.thread_time_ns",
)


def cases(end: rt.Slot) -> tuple[Callable[[], None], ...]:
    """Return what is timed in the task, in the order of `NAMES`."""
    task = TaskContext(watch=SlotWatch(end.failures))

    def timed() -> None:
        for _ in range(ROUNDS):
            with task.timed("work"):
                pass

    return (
        nothing,
        lambda: within(task.critical),
        timed,
        lambda: within(Empty),
        two_clocks,
    )


def sections_in_a_task(core: rt.CoreTable, blocks: int) -> dict[str, list[float]]:
    """Return nanoseconds for one section, by case; one block is one cycle of each."""
    slot = core.alloc("bench", "costs")
    core.configure(slot, period_ns=20_000_000, crit=5)
    with tempfile.TemporaryFile() as file:
        shape = (blocks + 2, len(NAMES))
        out = np.memmap(file, dtype=np.int64, mode="w+", shape=shape)
        out[:] = 0

        def body(end: rt.Slot) -> None:
            count, functions = -1, cases(end)

            def cycle(_dt: float) -> None:
                nonlocal count
                for case, function in enumerate(functions):
                    begun = time.thread_time_ns()
                    function()
                    took = time.thread_time_ns() - begun
                    if 0 <= count < blocks:
                        out[count, case] = took
                count += 1
                out[blocks + 1, 0] = count

            end.run(cycle, None, failing=lambda _kind: rt.CONTINUE)

        pid = rtbench.start_task(core, slot, body)
        rtbench.wait_for(lambda: out[blocks + 1, 0] >= blocks, "all blocks", 60.0)
        rtbench.end_task(core, slot, pid)
        times = np.array(out[:blocks], dtype=float) / ROUNDS
    return {
        name: list(times[:, case] - times[:, 0])
        for case, name in enumerate(NAMES)
        if case
    }


def main() -> None:
    """Measure and report; status 3 when the goal is missed."""
    parser = argparse.ArgumentParser(description="What parts cost.")
    parser.add_argument("--blocks", type=int, default=11)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    print(rtbench.machine())
    found = parts_in_c(args.core, args.blocks)
    core = rt.CoreTable(args.core)
    dispatcher = rt.Dispatcher(core)
    try:
        dispatcher.start()
        found |= sections_in_a_task(core, args.blocks)
    finally:
        dispatcher.stop()
        core.close()
    print(f"{'nanoseconds, median [least greatest] of blocks':45} {args.blocks} blocks")
    for name, values in found.items():
        print(f"{name:45} {rtbench.spread(values, 1)}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    spent = statistics.median(found[ACCOUNT])
    rtbench.judge([rtbench.verdict(f"{ACCOUNT}, ns,", spent, MOST_NS)])


if __name__ == "__main__":
    main()
