"""Transfers of the state variable table beside numpy, memcpy and a lock.

The cases are those of the thesis's Tables 2 and 3 (section 6.6.1): 1, 2 and 6 variables
of 6, 32 and 256 elements, here float64, read and written as one set and one by one.
Every contestant runs in every round, one after the other, so that whatever else the
machine does hits all of them; ratios are taken within a round, and medians over the
rounds are shown.

    python benchmarks/svar.py [--rounds N] [--markdown FILE]

Contestants:
    numpy      one numpy.copyto of the same bytes in one array
    memcpy     C memcpy of the same bytes through the same kind of Cython call
    lock       multiprocessing.Lock around a numpy copy per variable, in shared memory
    single     LocalTable.read and LocalTable.write, one call per variable
    set        LocalTable.copy_in(), and LocalTable.commit(now_ns, cycle) as the
               real-time loop calls it, of variables with FINITE no
    clock      LocalTable.commit(), which reads the clock itself
    guard      as set, but of variables that must be finite
"""

from __future__ import annotations

import argparse
import importlib.util
import mmap
import multiprocessing
import os
import platform
import shutil
import statistics
import subprocess
import sys
import sysconfig
import tempfile
import timeit
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from benchmarks import rtbench
from pbonet.config.model import Variable
from pbonet.svar import Freshness, Table

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

COUNTS, LENGTHS = (1, 2, 6), (6, 32, 256)
BLOCK_NS = 400_000
NUMPY_GOAL = 0.25
"""Of numpy.copyto, for 6 x [6]."""
MEMCPY_GOAL = 1.5
"""Of memcpy through the same kind of call, for 6 x [256]."""
GUARD_GOAL = 1.3
"""The same with a check of all values for NaN and infinity."""


class Case(NamedTuple):
    """How many variables of how many elements."""

    arrays: int
    length: int

    def __str__(self) -> str:
        return f"{self.arrays} x [{self.length}]"


class Result(NamedTuple):
    """Medians over the rounds."""

    ns: dict[str, float]
    to_numpy: dict[str, float]
    to_memcpy: dict[str, float]
    spread: dict[str, float]
    """Half the distance between the quartiles of `to_memcpy`."""


def build_cython(name: str, folder: Path) -> ModuleType:
    """Compile a file of this folder, with the flags of pbonet's own."""
    source = Path(__file__).with_name(f"{name}.pyx")
    root = source.parents[1]
    code = folder / f"{name}.c"
    target = folder / f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}"
    cython = [sys.executable, "-m", "cython", "-3", "-I", str(root)]
    subprocess.run([*cython, str(source), "-o", str(code)], check=True)
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        sys.exit("the benchmark needs a C compiler")
    include = sysconfig.get_paths()["include"]
    flags = ["-shared", "-fPIC", "-O3", "-std=c11", "-DNDEBUG", f"-I{include}"]
    built = [compiler, *flags, f"-I{root}", str(code), "-o", str(target)]
    subprocess.run(built, check=True)
    spec = importlib.util.spec_from_file_location(name, target)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def shared(size: int) -> np.ndarray[Any, Any]:
    """Return populated shared memory."""
    room = np.frombuffer(mmap.mmap(-1, size), np.uint8)
    room.fill(0)
    return room


def aligned(size: int) -> np.ndarray[Any, Any]:
    """Return private memory that begins at a cache line, as a local table does."""
    room = np.zeros(size + 64, np.uint8)
    skip = -room.ctypes.data % 64
    return room[skip : skip + size]


class Rivals:
    """One case: every contestant as a call without arguments, by direction."""

    def __init__(self, case: Case, port: Callable[..., Any], *, finite: bool) -> None:
        size = 8 * case.arrays * case.length
        names = [f"V{i}" for i in range(case.arrays)]
        self.table = Table.create(
            f"bench{os.getpid()}-{case.arrays}-{case.length}-{int(finite)}",
            [
                Variable(name=n, type="double", nelem=case.length, finite=finite)
                for n in [*names, "OUT"]
            ],
        )
        me = os.getpid()
        writer = self.table.local("writer", me, outvar=names)
        reader = self.table.local("reader", me, invar=names, outvar=["OUT"])
        reader.keep_fresh({self.table.index(name): Freshness() for name in names})
        for i, name in enumerate(names):
            writer.array(name)[:] = i + 0.5
        writer.claim()
        self.calls: dict[str, dict[str, Callable[[], object]]] = {
            "read": {},
            "write": {},
        }
        if finite:
            self.calls["write"]["guard"] = stamped(writer.commit)
            return
        self._plain(size, port)
        self._locked(case)
        self.calls["read"]["set"] = reader.copy_in
        self.calls["write"]["set"] = stamped(writer.commit)
        self.calls["write"]["clock"] = writer.commit
        self.calls["read"]["single"] = one_by_one(reader.read, names)
        self.calls["write"]["single"] = one_by_one(writer.write, names)
        assert reader.copy_in() == 0
        assert all((reader.array(n) == writer.array(n)).all() for n in names)

    def _plain(self, size: int, port: Callable[..., Any]) -> None:
        common = shared(size)
        for direction in ("read", "write"):
            private = aligned(size)
            pair = (private, common) if direction == "read" else (common, private)
            to, source = (side.view(np.float64) for side in pair)
            self.calls[direction]["numpy"] = copyto(to, source)
            rival = port(*pair)
            same = rival.copy_in if direction == "read" else stamped(rival.commit)
            self.calls[direction]["memcpy"] = same

    def _locked(self, case: Case) -> None:
        lock = multiprocessing.Lock()
        for direction in ("read", "write"):
            sides = [
                [shared(8 * case.length).view(np.float64) for _ in range(case.arrays)],
                [np.zeros(case.length) for _ in range(case.arrays)],
            ]
            if direction == "read":
                sides.reverse()
            pairs = list(zip(*sides, strict=True))
            self.calls[direction]["lock"] = locked(lock, pairs)


def stamped(commit: Callable[..., int]) -> Bare:
    """Return a commit that is given time and cycle."""
    return Bare("commit(123456789012345, 1234)", {"commit": commit})


def copyto(to: object, source: object) -> Bare:
    """Return one numpy.copyto."""
    return Bare("copyto(to, source)", {"copyto": np.copyto, "to": to, "source": source})


class Bare:
    """A statement, timed by itself: a Python function would add its frame."""

    def __init__(self, text: str, names: dict[str, object]) -> None:
        self.text = text
        self.names = names

    def __call__(self) -> object:
        """Run it once."""
        return eval(self.text, dict(self.names))  # noqa: S307 - our own text


def one_by_one(call: Callable[[str], int], names: list[str]) -> Bare:
    """Return single-variable transfers of all variables, as written out by hand."""
    text = "; ".join(f"call({name!r})" for name in names)
    return Bare(text, {"call": call})


def locked(lock: object, pairs: list[tuple[Any, Any]]) -> Bare:
    """Return copies of all pairs under a lock, as written out by hand."""
    copies = "; ".join(f"copyto(t{i}, s{i})" for i in range(len(pairs)))
    scope: dict[str, object] = {"lock": lock, "copyto": np.copyto}
    for i, (to, source) in enumerate(pairs):
        scope |= {f"t{i}": to, f"s{i}": source}
    return Bare(f"with lock: {copies}", scope)


def timer(call: Callable[[], object]) -> timeit.Timer:
    """Return a timer that runs a call or a bare statement in timeit's own loop."""
    if isinstance(call, Bare):
        return timeit.Timer(call.text, globals=call.names)
    return timeit.Timer("call()", globals={"call": call})


def measure(calls: dict[str, Callable[[], object]], rounds: int) -> Result:
    """Time all contestants of one direction, one block each per round."""
    timers = {name: timer(call) for name, call in calls.items()}
    numbers: dict[str, int] = {}
    for name, each in timers.items():
        each.timeit(1000)
        once = each.timeit(2000) / 2000
        numbers[name] = max(100, round(BLOCK_NS * 1e-9 / once))
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, each in timers.items():
            found[name].append(each.timeit(numbers[name]) / numbers[name] * 1e9)
    ratios = {
        rival: {
            name: [x / y for x, y in zip(values, found[rival], strict=True)]
            for name, values in found.items()
        }
        for rival in ("numpy", "memcpy")
    }
    quarters = {n: statistics.quantiles(r, n=4) for n, r in ratios["memcpy"].items()}
    return Result(
        {name: statistics.median(values) for name, values in found.items()},
        {name: statistics.median(r) for name, r in ratios["numpy"].items()},
        {name: statistics.median(r) for name, r in ratios["memcpy"].items()},
        {name: (q[2] - q[0]) / 2 for name, q in quarters.items()},
    )


def run(rounds: int) -> dict[tuple[Case, str], Result]:
    """Measure every case in both directions."""
    results: dict[tuple[Case, str], Result] = {}
    with tempfile.TemporaryDirectory() as folder:
        port = build_cython("svar_memcpy", Path(folder)).Port
        for case in map(Case._make, product(COUNTS, LENGTHS)):
            rivals = Rivals(case, port, finite=False)
            guarded = Rivals(case, port, finite=True)
            try:
                for direction, calls in rivals.calls.items():
                    every = {**calls, **guarded.calls[direction]}
                    results[case, direction] = measure(every, rounds)
            finally:
                rivals.table.destroy()
                guarded.table.destroy()
            print(f"{case}", end=" ", flush=True, file=sys.stderr)
    print(file=sys.stderr)
    return results


def report(results: dict[tuple[Case, str], Result], rounds: int) -> list[str]:
    """Return the results as Markdown lines."""
    lines = [
        f"{machine()}, Python {platform.python_version()}, numpy {np.__version__}; "
        f"median of {rounds} rounds, nanoseconds per call.",
        "",
        "| case | direction | numpy | memcpy | lock | single | **set** | clock adds "
        "| guard adds | set/numpy | set/memcpy |",
        "|---" * 11 + "|",
    ]
    for (case, direction), r in results.items():
        cells = [f"{r.ns[n]:.0f}" for n in ("numpy", "memcpy", "lock", "single")]
        cells.append(f"**{r.ns['set']:.0f}**")
        cells += [
            f"{r.ns[extra] - r.ns['set']:.0f}" if extra in r.ns else ""
            for extra in ("clock", "guard")
        ]
        cells.append(f"{r.to_numpy['set']:.2f}")
        cells.append(f"{r.to_memcpy['set']:.2f} ± {r.spread['set']:.2f}")
        lines.append(f"| {case} | {direction} | {' | '.join(cells)} |")
    return [*lines, "", *goals(results)]


def goals(results: dict[tuple[Case, str], Result]) -> list[str]:
    """Return one line for each goal: what was asked, what was measured."""
    lines: list[str] = []
    for case, rival, limit in (
        (Case(6, 6), "numpy", NUMPY_GOAL),
        (Case(6, 256), "memcpy", MEMCPY_GOAL),
    ):
        for direction in ("read", "write"):
            r = results[case, direction]
            got = (r.to_numpy if rival == "numpy" else r.to_memcpy)["set"]
            verdict = "met" if got <= limit else "NOT met"
            what = f"{case} {direction} at most {limit} x {rival}"
            lines.append(f"- {what}: {got:.2f}, **{verdict}**")
    got = results[Case(6, 256), "write"].to_memcpy["guard"]
    verdict = "met" if got <= GUARD_GOAL else "NOT met"
    what = f"{Case(6, 256)} write with guard at most {GUARD_GOAL} x memcpy"
    return [*lines, f"- {what}: {got:.2f}, **{verdict}**"]


def machine() -> str:
    """Return the processor's name and how many cores are usable."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    names = [
        x.partition(":")[2].strip() for x in text.splitlines() if "model name" in x
    ]
    name = names[0] if names else platform.machine()
    return f"{len(os.sched_getaffinity(0))} cores of {name}, Linux {platform.release()}"


def main() -> None:
    """Run the benchmark and print its table; fail when a goal is missed."""
    parser = argparse.ArgumentParser(
        description="Transfers beside numpy, memcpy and a lock."
    )
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--markdown", type=Path, help="also write the table there")
    options = parser.parse_args()
    results = run(options.rounds)
    lines = report(results, options.rounds)
    rtbench.judge(lines, options.markdown)


if __name__ == "__main__":
    main()
