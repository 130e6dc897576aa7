"""What the real-time benchmarks share: the C rival, tasks as processes, the machine."""

from __future__ import annotations

import gc
import os
import platform
import signal
import statistics
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pbonet.config.model import Variable
from pbonet.node import rt
from pbonet.svar import LocalTable, Table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

LEVEL = 44
"""What a task alone on its core gets (`muf_assign`)."""


class Loop(NamedTuple):
    """What one run of the C loop gave."""

    delays: NDArray[np.int64]
    missed: int
    cpu_ns: int


def compile_c(name: str, folder: Path) -> Path:
    """Return the program made of the C file of that name beside this one."""
    here = Path(__file__).parent
    program = folder / name
    native = here.parent / "pbonet" / "node" / "rt"
    options = ["-O2", "-std=c11", "-I", str(native), "-o", str(program)]
    subprocess.run(["cc", *options, str(here / f"{name}.c")], check=True)  # noqa: S607 - the compiler is where PATH says
    return program


def run_loop(program: Path, core: int, level: int, period: int, cycles: int) -> Loop:
    """Run the C loop."""
    arguments = [str(n) for n in (core, level, period, cycles)]
    done = subprocess.run([program, *arguments], check=True, capture_output=True)
    numbers = np.array(done.stdout.split(), dtype=np.int64)
    return Loop(numbers[2:], int(numbers[0]), int(numbers[1]))


class Tables:
    """A table of state variables with a group of in- and out-variables per task."""

    def __init__(self, tasks: int, arrays: int = 6, size: int = 6) -> None:
        self.names = [
            ([f"I{t}_{k}" for k in range(arrays)], [f"O{t}_{k}" for k in range(arrays)])
            for t in range(tasks)
        ]
        variables = [
            Variable(name=name, type="double", nelem=size)
            for ins, outs in self.names
            for name in ins + outs
        ]
        self.table = Table.create(f"bench{os.getpid()}", variables)

    def local(self, task: int) -> LocalTable:
        """Return the local table of a task, in the task's own process."""
        ins, outs = self.names[task]
        table = Table.attach(self.table.name)  # a fork does not inherit the memory
        local = table.local(f"t{task}", os.getpid(), invar=ins, outvar=outs)
        local.claim()
        return local


def start_task(core: rt.CoreTable, slot: int, body: Callable[[rt.Slot], None]) -> int:
    """Fork a task's process, fit for real time as a node makes it; return its pid.

    Args:
        core: The core's table.
        slot: The task's slot.
        body: Called in the new process with the slot's end; the process ends with it.
    """
    pid = os.fork()
    if pid:
        core.configure(slot, pid=pid)
        return pid
    status = 1
    try:
        rt.orphan_guard(signal.SIGUSR1, os.getppid())
        rt.lock_memory()
        rt.populate_pages()
        rt.prefault_stack()
        rt.set_timer_slack()
        rt.pin(core.core)
        end = rt.Slot(rt.CoreTable(core.core, member=False), slot)
        gc.collect()
        gc.freeze()
        gc.disable()
        body(end)
        end.disarm()
        status = 0
    except BaseException:  # noqa: BLE001 - the process ends without Python's own report
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def watch(core: rt.CoreTable, slot: int, period: int, *, on: bool) -> None:
    """Have the dispatcher look after everything that can fail, or after nothing.

    With a reserve, a least time and a handler of its own priority every cycle gives the
    dispatcher instants to look at the task again. None of these failures happens.

    Args:
        core: The core's table.
        slot: The task's slot.
        period: Nanoseconds; half of them are the reserve.
        on: Whether to look.
    """
    core.configure(
        slot,
        maxc_ns=period // 2 if on else 0,
        minc_ns=10_000 if on else 0,
        drop=3,
        handler=6 if on else 0,
        tells=on,
    )


def end_task(core: rt.CoreTable, slot: int, pid: int) -> None:
    """Ask a task to end, and wait for it.

    Raises:
        RuntimeError: It failed.
    """
    core.request(slot)
    _, status = os.waitpid(pid, 0)
    core.died(slot)
    core.free(slot)
    if status:
        msg = f"the task ended with status {status}"
        raise RuntimeError(msg)


def wait_for(condition: Callable[[], bool], what: str, seconds: float) -> None:
    """Wait until a condition holds.

    Raises:
        TimeoutError: It did not in time.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            msg = f"not within {seconds} s: {what}"
            raise TimeoutError(msg)
        time.sleep(0.02)


def thread_cpu_ns(pid: int) -> int:
    """Return the kernel's CPU time of a process's main thread."""
    text = Path(f"/proc/{pid}/task/{pid}/schedstat").read_text(encoding="ascii")
    return int(text.split()[0])


def spread(values: Sequence[float], digits: int) -> str:
    """Return the median, the least and the greatest."""
    low, high = min(values), max(values)
    return (
        f"{statistics.median(values):9.{digits}f} "
        f"[{low:7.{digits}f} {high:8.{digits}f}]"
    )


def machine() -> str:
    """Say where this is measured."""
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    models = [line.split(":")[1].strip() for line in info if "model name" in line]
    load = " ".join(f"{x:.1f}" for x in os.getloadavg())
    return (
        f"{models[0] if models else platform.machine()}, {os.cpu_count()} cores, "
        f"Linux {platform.release()} {rt.probe().preempt}, "
        f"Python {platform.python_version()}, load {load}"
    )


def verdict(what: str, got: float, most: float) -> str:
    """Return a line that says whether a goal is met."""
    met = "met" if got <= most else "NOT met"
    return f"- {what} at most {most:g}: {got:.3g}, **{met}**"


def judge(lines: Iterable[str], markdown: Path | None = None) -> None:
    """Print lines with verdicts; end with status 3 when a goal is missed (see run.py).

    Args:
        lines: What is printed.
        markdown: A file that gets the same.
    """
    lines = list(lines)
    print("\n".join(lines))
    if markdown is not None:
        markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if any("NOT met" in line for line in lines):
        sys.exit(3)
