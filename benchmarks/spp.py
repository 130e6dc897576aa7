"""What a special purpose processor costs its client, and its back ends beside numpy.

The client's part of a cycle (write, call, read, wait of seven numbers, recorded) stands
beside a plain copy of them; a batch stands beside one that does nothing. Median and
99 % quantile in us.

    python -m benchmarks.spp [--calls 3000]
    python -m benchmarks.spp --inline    # no executives, no native parts
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pbonet.errors import SppError
from pbonet.io.spp import Execution, SppEntry, batches

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pbonet.io.spp import Loaded

GOAL = 20.0
"""us that write, call, read and wait may take, 99 % quantile."""
CLOSE = 1e-5
"""Greatest difference between two back ends."""
KERNELS = str(Path(__file__).parents[1] / "tests" / "support" / "spp_kernels.py")
MANY = np.linspace(-3.0, 3.0, 4096 * 7, dtype="f4").reshape(4096, 7)
SQUASHED = np.tanh(MANY * np.float32(0.5))


def quantiles(times: list[int]) -> str:
    """Return the median and the 99 % quantile of nanoseconds, in us."""
    ordered = sorted(times)
    found = (ordered[int(len(ordered) * q)] / 1e3 for q in (0.5, 0.99))
    return " / ".join(f"{one:.1f}" for one in found)


def timed(calls: int, do: Callable[[], object]) -> list[int]:
    """Return how long each of several calls took."""
    times: list[int] = []
    for _ in range(calls):
        begin = time.perf_counter_ns()
        do()
        times.append(time.perf_counter_ns() - begin)
    return times


def back_ends() -> Iterator[tuple[str, Execution]]:
    """Yield the back ends of this machine, with their devices."""
    for driver in ("numpy", "warp", "torch"):
        for device in ("cpu",) if driver == "numpy" else ("cpu", "cuda:0"):
            try:
                entry = SppEntry(driver=driver, device=device)
                yield f"{driver} on {device}", Execution(entry, "bench")
            except SppError as error:
                sys.stdout.write(f"{driver} on {device}: {error.got}\n")


def inline(calls: int) -> bool:
    """Measure the back ends in this process; return whether they agree."""
    agree = True
    for name, execution in back_ends():
        begin = time.perf_counter()
        loaded = execution.load(KERNELS)
        took = time.perf_counter() - begin
        got = _squashed(loaded)
        apart = float(np.abs(got - SQUASHED).max())
        agree = agree and apart <= CLOSE
        moves, empty = _batch(loaded, "squash"), _batch(loaded, "nothing")
        sys.stdout.write(
            f"{name}: loaded in {took:.2f} s, {apart:.1e} from numpy; batch of "
            f"{MANY.nbytes // 1024} KiB in and out "
            f"{quantiles(timed(calls, partial(loaded.run, moves, 1)))} us, "
            f"empty {quantiles(timed(calls, partial(loaded.run, empty, 1)))} us\n"
        )
    return agree


def _batch(loaded: Loaded, routine: str) -> bytes:
    told = loaded.manifest()
    names = [name for name, _, _ in told["variables"]]
    batch = batches.Batch(batches.room_of_batch(loaded.variables), "bench")
    moves = routine == "squash"
    if moves:
        at = names.index("many")
        batch.write(at, loaded.variables[at], MANY)
    batch.call(told["routines"].index(routine), (0.5,) if moves else ())
    if moves:
        batch.read(names.index("squashed"))
    return bytes(batch.end(1))


def _squashed(loaded: Loaded) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    result = batches.unpack_result(loaded.run(_batch(loaded, "squash"), 1))
    if result.error is not None:
        raise result.error
    ((_, data),) = result.values
    return np.frombuffer(data, "f4").reshape(MANY.shape)


def as_a_task() -> None:
    """Run as a real-time task does, if this process may."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def hot(calls: int) -> bool:
    """Measure a client with an executive in numpy; return whether the goal is met."""
    from pbonet.io.spp import Spp, processors
    from pbonet.outside import Tape, using

    tape = Tape()
    numbers, copy = np.arange(7.0), np.zeros(7)
    with processors.using({"fpa": SppEntry(driver="numpy")}), using(tape):
        spp = Spp("fpa", KERNELS)
        x, u, nothing = map(spp.translate, ("x", "u", "nothing"))
        client: list[int] = []
        plain: list[int] = []
        as_a_task()
        gc.disable()
        clock = time.perf_counter_ns
        for _ in range(calls):
            a = clock()
            copy[:] = numbers
            b = clock()
            spp.write(x, numbers)
            spp.call(nothing)
            spp.read(u)
            spp.wait()
            c = clock()
            plain.append(b - a)
            client.append(c - b)
            spp.wait(None)
            tape.take()

        def trip() -> None:
            spp.call(nothing)
            spp.wait(None)
            tape.take()

        trips = timed(calls, trip)
        gc.enable()
        spp.finish()
    ratio = sorted(client)[calls // 2] / max(1, sorted(plain)[calls // 2])
    sys.stdout.write(
        f"write, call, read, wait: {quantiles(client)} us; a plain copy "
        f"{quantiles(plain)}; {ratio:.1f} times\n"
        f"round trip of an empty batch: {quantiles(trips)} us\n"
    )
    return sorted(client)[int(calls * 0.99)] <= GOAL * 1e3


def main() -> int:
    """Measure, and return 0 if the goal is met and all back ends agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=3000)
    parser.add_argument("--inline", action="store_true")
    told = parser.parse_args()
    good = inline(told.calls)
    if not told.inline:
        good = hot(told.calls) and good
    return 0 if good else 3


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("PBONET_RUN_DIR", folder + "/run")
        sys.exit(main())
