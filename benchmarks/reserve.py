"""Timing failures: how exactly a reserve is kept, and how soon its handler is there.

A task has a reserve of 5 ms of CPU time and uses more of it in every cycle. *Overshoot*
is the CPU time that it had used beyond that when the dispatcher lowered its
criticality: from then on it harms nobody. *Handler* is the time from the reserve's
exhaustion to the first line of the handler in Python. A task in a loop of Python is
measured, one within a single matmul of whole numbers (numpy does that in one thread,
and no handler runs before it has returned), and one that sleeps when its deadline is
reached, for which the time counts from the deadline. The rival, in turns with them:
the kernel's timers in a C program, CLOCK_THREAD_CPUTIME_ID for the busy ones and
CLOCK_MONOTONIC for the one asleep, from expiry to the first line of a C handler. The
least that a dispatcher could do is measured with them: a timer, a thread at a higher
level that reads it and sends a signal, the first line of a C handler.

*Safe* is the time from the same instant until a task's safe values are in the table
(`SAFE` in its RMOD), by their time stamp: the dispatcher commits them, whatever the
task does. These are blocks of their own, of a task without a handler in Python.

The time of a call is counted from the failure of the same release. A failure may
have no call: on a loaded machine its signal can come when the cycle has ended, or while
one of its kind still waits. The dispatcher and the task count these. Lost are as many
as exceed the calls and those.

Given are medians of the blocks' quantiles with the least and the greatest. With
``--awake`` the processors do not sleep meanwhile, as under an agent with that setting.
Status 3: a goal was missed.

    python -m benchmarks.reserve [--blocks 5] [--cycles 100] [--core 1] [--awake]
"""

from __future__ import annotations

import argparse
import bisect
import json
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks import rtbench
from pbonet.analysis.schedule.events import Event, turns
from pbonet.analysis.schedule.records import Decision
from pbonet.config import Variable
from pbonet.node import rt
from pbonet.node.wire.cpu_idle_states import IdleStateLock
from pbonet.svar import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

LIMIT_NS = 5_000_000
PERIOD_NS = 50_000_000
BUSY_NS = 8_000_000
ASLEEP = 0.02
SIZE = 256
"""Rows and columns of the matrix; its matmul takes longer than LIMIT_NS."""
QUANTILES = {"p50": 0.5, "p99": 0.99, "max": 1.0}
GOALS = {
    "handler Python": 25.0,
    "handler asleep": 100.0,
    "safe Python": 15.0,
    "safe numpy": 15.0,
    "safe asleep": 15.0,
}
"""Microseconds: the median of the blocks' medians."""


class Found(NamedTuple):
    """Nanoseconds of one block."""

    overshoot: NDArray[np.int64]
    handler: NDArray[np.int64]
    safe: NDArray[np.int64]
    lost: int = 0
    """Failures that had no call and were not counted as such."""


def in_python() -> None:
    """Compute in Python for BUSY_NS of CPU time."""
    end = time.thread_time_ns() + BUSY_NS
    while time.thread_time_ns() < end:
        pass


def in_numpy() -> Callable[[], None]:
    """Return what computes in one call of numpy."""
    matrix = np.ones((SIZE, SIZE), dtype=np.int64)
    out = np.empty_like(matrix)

    def work() -> None:
        np.matmul(matrix, matrix, out=out)

    return work


def asleep() -> None:
    """Wait."""
    time.sleep(ASLEEP)


WORK: dict[str, Callable[[], Callable[[], None]]] = {
    "Python": lambda: in_python,
    "numpy": in_numpy,
    "asleep": lambda: asleep,
}


class Failures:
    """Reads from the trace what the dispatcher found about one slot."""

    def __init__(self, core: rt.CoreTable, slot: int) -> None:
        self._core, self._slot = core, slot
        self._next = core.trace(1 << 62)[0]
        self._mark = self._release = -1
        self.found: dict[int, tuple[int, int]] = {}
        """Of each release: when its cycle failed and was told so, and the CPU time used
        beyond the reserve by then."""
        self.instants: list[int] = []
        """When each failure was found. A cycle that goes on beyond its period, because
        the machine stood still, can have two of one release, or none of its own."""

    def read(self) -> None:
        """Take in what has come since the last call.

        Raises:
            RuntimeError: The trace was read too late.
        """
        self._next, lost, trace = self._core.trace(self._next)
        if lost:
            msg = f"{lost} records of the trace were overwritten before they were read"
            raise RuntimeError(msg)
        for head, inputs, decisions in turns(trace):
            self._one(head.a, [*inputs, *decisions])

    def _one(self, now: int, records: list[Decision]) -> None:
        mine = {Event(r.kind): r for r in records if r.slot == self._slot}
        for r in records:
            if r.slot == self._slot and r.kind == Event.DONE and r.arg:
                self._mark, self._release = r.b, r.a  # it has released itself
        used = mine[Event.USED].a if Event.USED in mine else 0
        if Event.FAIL in mine and mine[Event.FAIL].arg >> 8:  # else it is only counted
            self.found[self._release] = now, used - self._mark - LIMIT_NS
            self.instants.append(now)
        if Event.RELEASE in mine:
            self._mark, self._release = used, mine[Event.RELEASE].a


def limit(core: rt.CoreTable, slot: int, work: str) -> None:
    """Set when cycles of this work fail."""
    if work == "asleep":
        core.configure(slot, deadline_ns=LIMIT_NS)
    else:
        core.configure(slot, maxc_ns=LIMIT_NS)


def run_task(core: rt.CoreTable, work: str, cycles: int) -> Found:
    """Measure one block.

    Raises:
        RuntimeError: No failure was handled.
    """
    slot = core.alloc("bench", f"reserve {work}")
    core.configure(slot, period_ns=PERIOD_NS, crit=5, drop=3, handler=6, tells=True)
    limit(core, slot, work)
    with tempfile.TemporaryFile() as file:
        out = np.memmap(file, dtype=np.int64, mode="w+", shape=(cycles + 2, 2))
        out[:] = 0

        def body(end: rt.Slot) -> None:
            instants, function, count = out.data, WORK[work](), 0

            def failing(_kind: str) -> int:
                nonlocal count
                at = time.monotonic_ns()
                if count < cycles + 2:
                    instants[count, 0] = at
                    instants[count, 1] = end.release_ns
                count += 1
                return rt.CONTINUE

            end.run(lambda _dt: function(), None, failing=failing)

        failures, uncalled = watched(core, slot, body, out)
        calls = [int(at) for at, _ in out]
        handled = {int(release): int(at) for at, release in out}
    lost = max(between(failures.instants, calls) - len(calls) - uncalled, 0)
    return matched(work, failures.found, handled)._replace(lost=lost)


def watched(
    core: rt.CoreTable,
    slot: int,
    body: Callable[[rt.Slot], None],
    out: NDArray[np.int64],
) -> tuple[Failures, int]:
    """Run a task until `out` is full; return its failures, and how many had no call."""
    failures = Failures(core, slot)
    pid = rtbench.start_task(core, slot, body)

    def all_there() -> bool:
        failures.read()
        return bool(out[-1, 1])

    rtbench.wait_for(all_there, "failures", 10 + 4e-9 * PERIOD_NS * len(out))
    uncalled = core.snapshot(slot).uncalled_failures
    rtbench.end_task(core, slot, pid)
    failures.read()
    return failures, uncalled


def run_safe(dispatcher: rt.Dispatcher, work: str, cycles: int) -> Found:
    """Measure one block of a task with safe values and no handler.

    Raises:
        RuntimeError: They were never written.
    """
    core, kind = dispatcher.table, "deadline" if work == "asleep" else "maxexec"
    slot = core.alloc("bench", f"safe {work}")
    core.configure(
        slot, period_ns=PERIOD_NS, crit=5, drop=3, tells=False, safe_at=[kind]
    )
    limit(core, slot, work)
    name, variable = f"reserve{os.getpid()}", Variable(name="Y", type="double", nelem=6)
    with (
        Table.create(name, [variable]) as table,
        tempfile.TemporaryFile() as file,
    ):
        out = np.memmap(file, dtype=np.int64, mode="w+", shape=(cycles + 2, 2))
        out[:] = 0
        own = table.local("values", os.getpid(), outvar=["Y"])
        dispatcher.keep_values(slot, table.arena, own.keep_safe({"Y": -1.0}))

        def body(end: rt.Slot) -> None:
            instants, function, count = out.data, WORK[work](), 0
            seen = Table.attach(name)
            local = seen.local("bench", os.getpid(), outvar=["Y"])
            local.keep_safe({"Y": -1.0})
            local.claim()
            while end.run(lambda _dt: function(), local) == rt.ABORTED:
                if count < cycles + 2:
                    instants[count, 0] = seen.info("Y").time_ns
                    instants[count, 1] = end.release_ns
                count += 1

        failures, _ = watched(core, slot, body, out)
        dispatcher.drop_values(slot)
        table.destroy()
        safe = {int(release): int(at) for at, release in out}
    found = matched(work, failures.found, safe)
    return Found(found.overshoot[:0], found.handler[:0], found.handler)


def between(failures: list[int], calls: list[int]) -> int:
    """Return how many failures came from that of the first call until the last call.

    Args:
        failures: When each was found, ascending.
        calls: When the handler's calls began.
    """
    first = bisect.bisect_right(failures, min(calls)) - 1
    return bisect.bisect_right(failures, max(calls)) - max(first, 0)


def matched(
    work: str, found: dict[int, tuple[int, int]], handled: dict[int, int]
) -> Found:
    """Return the times of the failures that were handled, by their releases.

    Raises:
        RuntimeError: No failure was handled.
    """
    both = sorted(handled.keys() & found.keys())  # not those amid which a period ended
    if not both:
        msg = f"{work}: none of {len(found)} failures was handled in its cycle"
        raise RuntimeError(msg)
    at = np.array([handled[release] for release in both], np.int64)
    if work == "asleep":
        return Found(at[:0], at - np.array(both, np.int64) - LIMIT_NS, at[:0])
    when, over = np.array([found[release] for release in both], np.int64).T
    return Found(over, at - (when - over), at[:0])


def run_rival(program: Path, core: int, level: int, what: str, n: int) -> Found:
    """Measure one block of the kernel's timers."""
    command = [str(x) for x in (program, core, level, LIMIT_NS, n, what)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    late = np.array(done.stdout.split(), dtype=np.int64)
    return Found(late if what == "busy" else late[:0], late, late[:0])


def report(found: dict[str, list[Found]]) -> dict[str, dict[str, list[float]]]:
    """Print the table and return what it says."""
    result: dict[str, dict[str, list[float]]] = {}
    print(f"{'microseconds':31}" + " ".join(f"{name:>27}" for name in QUANTILES))
    for what in ("overshoot", "handler", "safe"):
        for name, blocks in found.items():
            values = [one for b in blocks if len(one := getattr(b, what))]
            if not values:
                continue
            row = {
                quantile: [
                    float(np.quantile(np.asarray(v, np.float64), q)) / 1e3
                    for v in values
                ]
                for quantile, q in QUANTILES.items()
            }
            result[f"{what} {name}"] = row
            cells = " ".join(rtbench.spread(v, 1) for v in row.values())
            print(f"{what:10} {name:20}{cells}")
    return result


def goals(
    result: dict[str, dict[str, list[float]]], found: dict[str, list[Found]]
) -> Iterator[str]:
    """Yield a line for each goal."""
    for what, most in GOALS.items():
        p50 = statistics.median(result[what]["p50"])
        yield rtbench.verdict(f"{what}, p50, us,", p50, most)
    lost = sum(block.lost for blocks in found.values() for block in blocks)
    yield rtbench.verdict("failures neither handled nor counted,", lost, 0)


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Timing failures.")
    parser.add_argument("--blocks", type=int, default=5)
    parser.add_argument("--cycles", type=int, default=100)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--awake", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    awake = IdleStateLock() if args.awake else None
    if awake is not None and awake.limits:
        parser.error(awake.limits[0])
    core = rt.CoreTable(args.core)
    dispatcher = rt.Dispatcher(core)
    level = rtbench.LEVEL if dispatcher.backend == "fifo" else 0
    rivals = {
        "C, kernel, busy": "busy",
        "C, kernel, asleep": "asleep",
        "C, thread, busy": "thread",
        "C, thread, asleep": "thread-asleep",
    }
    found: dict[str, list[Found]] = {name: [] for name in (*WORK, *rivals)}
    print(rtbench.machine())
    print(
        f"back end {dispatcher.backend}, {args.blocks} blocks of {args.cycles} cycles, "
        f"limit {LIMIT_NS / 1e6:g} ms, processors {'awake' if awake else 'as they are'}"
    )
    try:
        with tempfile.TemporaryDirectory() as folder:
            program = rtbench.compile_c("cputimer", Path(folder))
            for _ in range(args.blocks):
                for name, what in rivals.items():
                    found[name].append(
                        run_rival(program, args.core, level, what, args.cycles)
                    )
                dispatcher.start()
                for work in WORK:
                    found[work].append(run_task(core, work, args.cycles))
                    found[work].append(run_safe(dispatcher, work, args.cycles))
                dispatcher.stop()
    finally:
        dispatcher.stop()
        core.close()
        if awake is not None:
            awake.close()
    result = report(found)
    if args.json:
        told = {"machine": rtbench.machine(), **result}
        args.json.write_text(json.dumps(told, indent=1), encoding="utf-8")
    rtbench.judge(goals(result, found))


if __name__ == "__main__":
    main()
