"""Modules in C beside the same in Python: the call, a whole cycle, and swaps.

First the call of an empty ``cycle``: by pointer, as the native loop does it, and
through the interpreter, both over the bare call of the function in C. Then the PID
controller of ``examples/c_pid`` and its twin, over six joints. Then whole cycles of
empty tasks, in C and in Python in turns, on a core of their own with a dispatcher, a
table and a ring: CPU time from the end of one cycle to the end of the next, of each two
that run one after the other. Of the same cycles the cycle proper is measured, too: the
time from the return of the thread's wait to its next wait (``between_waits.c``), which
the goal is for. The rest of the CPU time is the wake-up, which no task can change and
which varies with the machine. Last, swaps
of the controller and its twin over a real agent, while the axes and their reference go
on: no release between the last cycle of one controller and the first of the other may
be without a cycle. What the machine takes is told from what a swap takes by a C loop
that does nothing but sleep, on the same core and above the dispatcher, as in
`benchmarks.swap`: it wakes up in the middle between two releases, and nothing of pbonet
can make it late. A release without a cycle is excused if the loop was late by a quarter
of a period or more meanwhile.

    python -m benchmarks.cmodules [--blocks 7] [--seconds 2] [--swaps 200] [--core 1]
"""

from __future__ import annotations

import argparse
import ctypes
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

import pbonet
from benchmarks import rtbench
from benchmarks.svar import build_cython
from benchmarks.swap import Stalls, most_late
from pbonet.cmodule import NativeMethod, NativeState, SharedObject
from pbonet.config import Library
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.node import rt
from pbonet.node.ring._ring import Ring
from pbonet.pbo import TaskContext
from pbonet.testing import Bench
from pbonet.xm.net.messages import AgentInfo, Hello

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import ModuleType

    from numpy.typing import NDArray

EXAMPLE = Path(__file__).parents[1] / "examples" / "c_pid"
CALL_GOAL = 10.0
"""Nanoseconds over the bare call of an empty function in C."""
CYCLE_GOAL = 0.9
"""Of a whole cycle of an empty task in Python."""
CALLS = 200_000
RATE = 2000.0
PERIOD = 2_000_000
"""Nanoseconds, of the controllers and the axes."""
LATE = PERIOD // 4
"""So late the loop must have been to excuse a release without a cycle."""
PAIR = "pid", "joint_pid"
EMPTY = """
#include <pbonet.h>
struct empty { double unused; };
static int cycle(void *state, pbo_task *task)
{
    (void)state;
    (void)task;
    return PBO_OK;
}
PBO_MODULE(struct empty, "Nothing.", .cycle = cycle);
"""


class Empty:
    """An empty module, as far as the loop sees it."""

    def cycle(self, dt: float) -> None:
        """Do nothing."""


def built(source: Path, target: Path) -> SharedObject:
    """Compile a module in C and load it."""
    flags = ["-std=gnu11", "-O2", "-ffp-contract=off", "-fPIC", "-shared"]
    include = f"-I{pbonet.get_include()}"
    command = ["cc", *flags, include, str(source), "-o", str(target)]
    subprocess.run(command, check=True)
    return SharedObject(str(target))


def in_c(
    shared: SharedObject,
    arrays: Mapping[str, NDArray[Any]] | None = None,
    values: Mapping[str, object] | None = None,
) -> NativeMethod:
    """Return ``cycle`` of a new instance of a module in C."""
    state = NativeState(shared, TaskContext(), arrays or {}, values or {})
    return NativeMethod(state, "cycle")


def timed(call: Callable[[], None]) -> float:
    """Return nanoseconds of one of the calls that are made at once."""
    begun = time.perf_counter_ns()
    call()
    return (time.perf_counter_ns() - begun) / CALLS


def calls(native: ModuleType, folder: Path, blocks: int) -> dict[str, list[float]]:
    """Return nanoseconds per call of each kind, a value for each block."""
    (folder / "empty.c").write_text(EMPTY, encoding="utf-8")
    empty = in_c(built(folder / "empty.c", folder / "empty.so"))
    gains = {"kp": 100.0, "limit": 20.0, "ki": 50.0, "kd": 10.0}
    values: dict[str, Any] = {"ndof": 6, "q_ref": [0.1] * 6}
    pid_file = folder / "pid.so"
    built(EXAMPLE / "pid.c", pid_file)
    law = Library([folder]).load("pid").cls
    twin = Library().load("joint_pid").cls
    in_python = Bench(twin, values, params=gains)
    in_python.on()
    as_c = Bench(law, values, params=gains)
    as_c.on()
    arrays = {name: np.zeros(6) for name in ("q_ref", "q", "qd", "tau")}
    pid = in_c(
        SharedObject(str(pid_file)), {"ndof": np.array([6], "i4"), **arrays}, gains
    )
    cycle = type(in_python.module).cycle.__get__(in_python.module)
    kinds: dict[str, Callable[[], None]] = {
        "empty, function in C alone": lambda: native.bare(empty, CALLS),
        "empty, by pointer": lambda: native.by_pointer(empty, CALLS),
        "empty, method in Python": lambda: native.by_object(Empty().cycle, CALLS),
        "PID of 6 joints, by pointer": lambda: native.by_pointer(pid, CALLS),
        "PID of 6 joints, method in Python": lambda: native.by_object(cycle, CALLS),
    }
    found: dict[str, list[float]] = {kind: [] for kind in kinds}
    for _ in range(blocks):
        for kind, call in kinds.items():
            found[kind].append(timed(call))
    return found


class Waits:
    """The waits of a task, in a process that was begun with `waits_library`."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(os.environ["LD_PRELOAD"])
        for function in ("between_waits_count", "between_waits"):
            getattr(self._library, function).restype = ctypes.c_int64
        self._library.between_waits.argtypes = [ctypes.c_int64]

    def begin(self) -> None:
        """Measure the calling thread from now on."""
        self._library.between_waits_begin()

    def between(self) -> list[int]:
        """Return nanoseconds from the end of each wait to the next one."""
        count = self._library.between_waits_count()
        return [self._library.between_waits(i) for i in range(count)]


def waits_library(folder: Path) -> str:
    """Compile what `Waits` needs; return its file, to be loaded before all else."""
    source, target = Path(__file__).with_name("between_waits.c"), folder / "waits.so"
    command = ["cc", "-O2", "-fPIC", "-shared", str(source), "-o", str(target)]
    subprocess.run(command, check=True)
    return str(target)


class Cycles(NamedTuple):
    """Nanoseconds of a task's cycles, the median of each block."""

    cpu: list[float]
    """CPU time from the end of one cycle to the end of the next."""
    proper: list[float]
    """Time from the end of a wait to the beginning of the next one."""


class Running(NamedTuple):
    """A task that runs."""

    slot: int
    pid: int
    ring: rt.Ring


def started(
    core: rt.CoreTable, tables: rtbench.Tables, waits: Waits, cycle: Callable[[], Any]
) -> Running:
    """Start an empty task; `cycle` makes its method, in its process."""
    slot = core.alloc("bench", "empty")
    core.configure(slot, period_ns=round(1e9 / RATE), crit=5, priority=0)
    name = f"empty{os.getpid()}"

    def body(end: rt.Slot) -> None:
        ring = rt.Ring.create(name, 1 << 22)
        method = cycle()
        waits.begin()
        end.run(method, tables.local(0), ring=ring, failing=lambda _kind: rt.CONTINUE)

    pid = rtbench.start_task(core, slot, body)
    rtbench.wait_for(lambda: core.snapshot(slot).cycles >= 100, "cycles", 30.0)
    return Running(slot, pid, rt.Ring.attach(name))


def whole_cycles(
    number: int, shared_object: str, blocks: int, seconds: float
) -> dict[str, Cycles]:
    """Return what cycles take on a core, in a process that has `waits_library`."""
    core = rt.CoreTable(number)
    leader = rt.Dispatcher(core)
    leader.start()
    try:
        return cycles_on(core, shared_object, blocks, seconds)
    finally:
        leader.stop()
        core.close()


def cycles_on(
    core: rt.CoreTable, shared_object: str, blocks: int, seconds: float
) -> dict[str, Cycles]:
    """Return what cycles take, of tasks in Python and in C in turns."""
    tables, waits, shared = rtbench.Tables(2), Waits(), SharedObject(shared_object)
    makers: dict[str, Callable[[], Any]] = {
        "empty task in Python": lambda: Empty().cycle,
        "empty task in C": lambda: in_c(shared),
    }
    found = {name: Cycles([], []) for name in makers}
    for block in range(blocks):
        order = list(makers.items())
        for name, maker in order if block % 2 else reversed(order):
            task = started(core, tables, waits, maker)
            task.ring.drain()
            time.sleep(seconds)
            records = [one for one in task.ring.drain() if not one.kind]
            rtbench.end_task(core, task.slot, task.pid)
            task.ring.destroy()
            found[name].cpu.append(statistics.median(one.cpu_ns for one in records))
            found[name].proper.append(statistics.median(waits.between()))
    tables.table.destroy()
    return found


def share(found: dict[str, list[float]]) -> float:
    """Return C's share of Python's, of blocks that ran one after the other."""
    pairs = zip(*found.values(), strict=True)
    shares: list[float] = [c / python for python, c in pairs]
    return statistics.median(shares)


class Losses(NamedTuple):
    """Releases without a cycle, in which the C loop was on time, or was late, too."""

    on_time: int = 0
    late: int = 0


class Releases(NamedTuple):
    """Releases of two controllers of which one is ON at any time."""

    all: int
    at_swaps: Losses
    """Between a cycle of one and a cycle of the other."""
    elsewhere: Losses
    dropped: int = 0
    """Cycles without a record; then releases seem to be lost that were not."""


class Drained:
    """Rings that are drained while swaps are under way.

    A swap may take longer than a ring has room for, on a busy machine, and a full ring
    drops what comes.
    """

    def __init__(self, names: list[str]) -> None:
        self.releases: list[tuple[int, int]] = []
        """Of the cycles that ran: instant, and whose."""
        self.dropped = 0
        self._rings = [Ring.attach(name) for name in names]
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._drain)

    def __enter__(self) -> Self:
        self._take()
        self._before = [ring.lost for ring in self._rings]
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        self._take()
        lost = [ring.lost for ring in self._rings]
        self.dropped = sum(lost) - sum(self._before)
        for ring in self._rings:
            ring.close()

    def _drain(self) -> None:
        while not self._ends.wait(0.02):
            self._take()

    def _take(self) -> None:
        for whose, ring in enumerate(self._rings):
            cycles = [one for one in ring.drain() if not one.kind]
            self.releases += [(one.release_ns, whose) for one in cycles]


def swaps(folder: Path, count: int) -> Releases:
    """Swap the controller and its twin; return what became of their releases."""
    copy = folder / "c_pid"
    shutil.copytree(EXAMPLE, copy, ignore=shutil.ignore_patterns("*.so"))
    make = ["make", "--silent", "-C", str(copy), f"PYTHON={sys.executable}"]
    subprocess.run(make, check=True)
    os.environ["PBONET_RUN_DIR"] = f"{folder}/run"
    with Embedded("default", libraries=[str(copy)]) as agents:
        agents.start(["arm0"])
        job = copy / "c_pid.job"
        with Subsystem(job, warned=lambda _text: None, record="off") as axes:
            axes.start()
            axes.spawn("joint_pid")
            core = axes.clients.call("arm0", Hello(), AgentInfo).core
            loop = Stalls(folder, core, tasks=("axes",), period=PERIOD)
            begun = time.monotonic_ns()  # cycles from before are in the rings, too
            with Drained([axes.status(task).ring for task in PAIR]) as drained:
                for number in range(count):
                    axes.wait(0.05)
                    axes.swap(*(PAIR if number % 2 == 0 else PAIR[::-1]))
                axes.wait(0.05)
            late = loop.end()[1]
    releases = sorted(one for one in drained.releases if one[0] >= begun)
    return judged(releases, late, drained.dropped)


def judged(
    releases: list[tuple[int, int]], late: list[tuple[int, int]], dropped: int = 0
) -> Releases:
    """Return which releases had no cycle, and whether the C loop was late then.

    Args:
        releases: Of the cycles that ran: instant, and whose.
        late: Of the loop's late wake-ups: when it was due, and when it came.
        dropped: Cycles that ran, but whose records the rings had no room for.
    """
    lost = {True: Losses(), False: Losses()}
    for (begin, one), (end, other) in pairwise(releases):
        missed = max(round((end - begin) / PERIOD) - 1, 0)
        was_late = most_late(late, begin, end) >= LATE
        on_time, excused = lost[one != other]
        lost[one != other] = Losses(
            on_time + missed * (not was_late), excused + missed * was_late
        )
    missed = sum(lost[True]) + sum(lost[False])
    return Releases(len(releases) + missed, lost[True], lost[False], dropped)


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Modules in C beside Python's.")
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--swaps", type=int, default=200)
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(rtbench.machine())
        called = calls(build_cython("cmodules_calls", folder), folder, args.blocks)
        for kind, ns in called.items():
            print(f"{kind:35} {rtbench.spread(ns, 1)} ns")
        os.environ["LD_PRELOAD"] = waits_library(folder)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as apart:
            wanted = args.core, str(folder / "empty.so"), args.blocks, args.seconds
            cycled = apart.submit(whole_cycles, *wanted).result()
        del os.environ["LD_PRELOAD"]
        for kind, (cpu, own) in cycled.items():
            wake = [both - one for both, one in zip(cpu, own, strict=True)]
            print(
                f"{kind:25} {rtbench.spread(own, 0)} ns a cycle, and "
                f"{rtbench.spread(wake, 0)} of CPU time for the wake-up"
            )
        done = swaps(folder, args.swaps)
        print(
            f"{args.swaps} swaps: {done.all} releases; without a cycle at swaps "
            f"{done.at_swaps.on_time} (and {done.at_swaps.late} while the loop was "
            f"late), elsewhere {done.elsewhere.on_time} (and {done.elsewhere.late}); "
            f"{done.dropped} cycles without a record"
        )
    low = {kind: min(ns) for kind, ns in called.items()}
    over = low["empty, by pointer"] - low["empty, function in C alone"]
    whole = share({kind: one.cpu for kind, one in cycled.items()})
    proper = share({kind: one.proper for kind, one in cycled.items()})
    rtbench.judge([
        rtbench.verdict("call over the bare function, ns,", over, CALL_GOAL),
        rtbench.verdict(
            "cycle proper of an empty task, C over Python,", proper, CYCLE_GOAL
        ),
        f"- the same cycle with its wake-up, in CPU time: {whole:.3g}, "
        f"{'above' if whole > CYCLE_GOAL else 'within'} {CYCLE_GOAL:g}; not judged, "
        "since the wake-up is the machine's",
        rtbench.verdict(
            "releases lost at swaps, but for stalls", done.at_swaps.on_time, 0
        ),
    ])


if __name__ == "__main__":
    main()
