"""A set of numbers from one process to another: what a call costs, and how late it is.

The set is six arrays of float64, of which a reader must never see parts of two commits.
One process publishes and one takes, each on its own core where there are two. Every
rival takes its turn in every round, so that whatever else the machine does hits all of
them, and ratios are taken within a round.

warm        both work without a pause; the time of a call, and of a call that brought
            a new set
cold        both work at 1 kHz and sleep between, as modules do: caches are cold
late        a set is published at 1 kHz: until the other process has it, by polling, or
            by waiting where the rival has threads of its own
processor   of both processes for a set at 1 kHz, less that of two which only sleep
"""

from __future__ import annotations

import contextlib
import gc
import math
import multiprocessing
import os
import secrets
import signal
import statistics
import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks.rivals.cyclonedds_topic import CycloneDdsTopic
from benchmarks.rivals.iceoryx2_service import Iceoryx2Blackboard, Iceoryx2PubSub
from benchmarks.rivals.locked_numpy import LockedNumpy
from benchmarks.rivals.pbonet_table import PbonetTable
from benchmarks.rivals.rival import (
    ARRAYS,
    Reader,
    Rival,
    Writer,
    installed,
    whole,
)
from benchmarks.rivals.zenoh_key import ZenohKey
from pbonet.node import rt

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkProcess

    from numpy.typing import NDArray

RIVALS: tuple[type[Rival], ...] = (
    PbonetTable,
    Iceoryx2Blackboard,
    Iceoryx2PubSub,
    LockedNumpy,
    ZenohKey,
    CycloneDdsTopic,
)
LENGTHS = (6, 256)
PERIOD = 1_000_000
AHEAD = 20_000_000
"""Nanoseconds from the order to the begin of a block."""
OPEN_SECONDS = 60.0
END_SECONDS = 5.0
FEWEST = 100
"""Calls or sets of a block that counts; with fewer it measures the scheduler."""


class Block(NamedTuple):
    """What one side of a rival measured in one block."""

    p50: float
    """Nanoseconds of a call; in `late`, from the commit until the set is there; NaN:
    there were too few."""
    p99: float
    calls: int
    torn: int
    cpu: float
    """Nanoseconds of the processor for each period, of all threads."""


class Sleeps(Rival):
    """Two processes that only sleep, fill arrays and read the clock."""

    name = "nothing"

    def writer(self) -> Writer:
        """Publish nothing."""
        return Writer([np.zeros(self.floats)], int)

    def reader(self) -> Reader:
        """Take what is always the same."""
        own = [np.zeros(self.floats)]
        return Reader(lambda: own, whole)


class Times:
    """Times of calls, less the clock's own."""

    def __init__(self) -> None:
        clock = time.perf_counter_ns
        empty = [-(clock() - clock()) for _ in range(1000)]
        self.clock = statistics.median(empty)
        self.taken: list[int] = []
        self.torn = 0

    def block(self, cpu_ns: int, periods: float) -> Block:
        """Return what is to be known of them."""
        used = cpu_ns / max(periods, 1.0)
        if len(self.taken) < FEWEST:
            return Block(math.nan, math.nan, len(self.taken), self.torn, used)
        each = sorted(self.taken)
        p50, p99 = (each[int(share * (len(each) - 1))] for share in (0.5, 0.99))
        return Block(
            max(p50 - self.clock, 1.0), p99 - self.clock, len(each), self.torn, used
        )


def number_of(arrays: Sequence[NDArray[np.float64]]) -> tuple[float, bool]:
    """Return the number of a set, and whether all of it is of that number."""
    number = float(arrays[0][0])
    return number, all(one[0] == number and one[-1] == number for one in arrays)


def periods(begin: int, seconds: float) -> Iterator[int]:
    """Yield once in a period and sleep between; periods that are over are left out."""
    now, sleep, due = time.monotonic_ns, time.sleep, begin
    end = begin + int(seconds * 1e9)
    while due < end:
        if (left := due - now()) > 0:
            sleep(left * 1e-9)
        yield due
        due += PERIOD * max((now() - due) // PERIOD + 1, 1)


def ticks(begin: int, seconds: float) -> Iterator[int]:
    """Yield without a pause."""
    now = time.monotonic_ns
    time.sleep(max(begin - now(), 0) * 1e-9)
    end = begin + int(seconds * 1e9)
    while now() < end:
        yield begin


def publish(end: Writer, turns: Iterator[int], times: Times, number: int) -> int:
    """Publish sets, each of one number and with the time of its commit."""
    clock, call = time.perf_counter_ns, end.publish
    for _ in turns:
        number += 1
        for array in end.arrays:
            array[:] = number
        end.arrays[0][1] = time.monotonic_ns()
        begin = clock()
        call()
        times.taken.append(clock() - begin)
    return number


def take(end: Reader, turns: Iterator[int], times: Times, number: float) -> float:
    """Take sets; those that are new count."""
    clock, call = time.perf_counter_ns, end.take
    for _ in turns:
        begin = clock()
        taken = call()
        ended = clock()
        if taken is None:
            continue
        new, complete = number_of(end.arrays(taken))
        if new != number:
            number = new
            times.torn += not complete
            times.taken.append(ended - begin)
    return number


def take_late(end: Reader, until: int, times: Times, number: float) -> float:
    """Take each new set as soon as it is there; how late that is counts.

    The writer goes on for some time, so that no wait is the last.
    """
    now, call = time.monotonic_ns, end.wait or end.take
    while now() < until:
        taken = call()
        taken_at = now()
        if taken is None:
            continue
        arrays = end.arrays(taken)
        if (new := float(arrays[0][0])) != number:
            number = new
            times.taken.append(taken_at - int(arrays[0][1]))
    times.clock = 0.0
    return number


def serve(rival: Rival, side: str, core: int, pipe: Connection) -> None:
    """Be one side of a rival in this process, and measure when the parent says so."""
    rt.orphan_guard(signal.SIGUSR1, os.getppid())
    end: Writer | Reader = rival.writer() if side == "writer" else rival.reader()
    os.sched_setaffinity(0, {core})  # threads of the rival's own stay free
    pipe.send("open")
    gc.disable()
    number = 0.0
    while (order := pipe.recv()) is not None:
        mode, seconds, begin = order
        times = Times()
        before = time.process_time_ns()
        begin += PERIOD // 2 * (side == "reader")
        turns = (ticks if mode == "warm" else periods)(begin, seconds)
        if isinstance(end, Writer):
            number = publish(end, turns, times, int(number))
        elif mode == "late":
            number = take_late(end, begin + int(8e8 * seconds), times, number)
        else:
            number = take(end, turns, times, number)
        used = time.process_time_ns() - before
        pipe.send(times.block(used, seconds * 1e9 / PERIOD))
        gc.collect()
    del end  # so that a rival removes what it has made
    gc.collect()
    os._exit(0)  # its threads do not hold up the end


class Pair:
    """Both processes of a rival.

    Raises:
        RuntimeError: One of them could not open its end.
    """

    def __init__(self, rival: Rival, cores: tuple[int, int]) -> None:
        self.rival = rival
        self.pipes: list[Connection] = []
        self.processes: list[ForkProcess] = []
        fork = multiprocessing.get_context("fork")
        for side, core in zip(("writer", "reader"), cores, strict=True):
            ours, theirs = fork.Pipe()
            process = fork.Process(
                target=serve, args=(rival, side, core, theirs), daemon=True
            )
            process.start()
            theirs.close()
            self.pipes.append(ours)
            self.processes.append(process)
            if not ours.poll(OPEN_SECONDS) or not _opened(ours):
                self.close()
                msg = f"{rival.name}: the {side} did not open"
                raise RuntimeError(msg)

    def measure(self, mode: str, seconds: float) -> tuple[Block, Block]:
        """Have both work for a time; return what the writer and the reader found.

        Raises:
            RuntimeError: One of them does not come to its end.
        """
        begin = time.monotonic_ns() + AHEAD
        for pipe in self.pipes:
            pipe.send((mode, seconds, begin))
        for pipe in self.pipes:
            if not pipe.poll(seconds + OPEN_SECONDS):
                msg = f"{self.rival.name}: no end of a block of {seconds:g} s, {mode}"
                raise RuntimeError(msg)
        writer, reader = (pipe.recv() for pipe in self.pipes)
        return writer, reader

    def close(self) -> None:
        """End both."""
        for pipe in self.pipes:
            with contextlib.suppress(OSError):
                pipe.send(None)
        for process in self.processes:
            process.join(END_SECONDS)
            process.kill()
            process.join()
        self.rival.close()


def _opened(pipe: Connection) -> bool:
    try:
        return bool(pipe.recv() == "open")
    except EOFError:
        return False


class Figures(NamedTuple):
    """All rounds of one rival with one size."""

    blocks: dict[str, list[tuple[Block, Block]]]
    """Of the writer and the reader, by mode."""

    def ns(self, mode: str, side: int) -> list[float]:
        """Return the median of each round."""
        return [both[side].p50 for both in self.blocks[mode]]

    def cpu(self) -> list[float]:
        """Return the processor time for a set in each round, of both sides."""
        return [writer.cpu + reader.cpu for writer, reader in self.blocks["cold"]]

    def torn(self) -> int:
        """Return how many sets were of parts of several commits."""
        return sum(reader.torn for some in self.blocks.values() for _, reader in some)


Found = dict[tuple[str, int], Figures]


def present(told: Callable[[str], None]) -> list[type[Rival]]:
    """Return the rivals that are installed, and tell of the others."""
    there: list[type[Rival]] = []
    for rival in RIVALS:
        if rival.package and not installed(rival.package):
            told(f"{rival.name}: skipped, {rival.package} is not installed")
        else:
            there.append(rival)
    return there


def measure(rounds: int, seconds: float, told: Callable[[str], None]) -> Found:
    """Measure every rival that is installed, with every size, in turns."""
    first, *more = sorted(os.sched_getaffinity(0))
    cores = (first, more[0] if more else first)
    found: Found = {}
    for length in LENGTHS:
        pairs: list[Pair] = []
        try:
            for kind in [*present(told if length == LENGTHS[0] else _nobody), Sleeps]:
                tag = f"rivals-{secrets.token_hex(4)}"
                try:
                    pairs.append(Pair(kind(length, tag), cores))
                except RuntimeError as error:
                    if kind is PbonetTable:
                        raise
                    told(f"{error}; skipped with {ARRAYS} x [{length}]")
            for number in range(rounds):
                told(f"{ARRAYS} x [{length}], round {number + 1} of {rounds}")
                _round(pairs, seconds, found, told)
        finally:
            for pair in pairs:
                pair.close()
    return found


def _nobody(_: str) -> None:
    """Say nothing again."""


def _round(
    pairs: list[Pair], seconds: float, found: Found, told: Callable[[str], None]
) -> None:
    """Measure each pair once in each mode; a rival that fails is left out from then on.

    Raises:
        RuntimeError: That of pbonet failed.
        EOFError: The same: one of its processes has ended.
    """
    for mode in ("warm", "cold", "late"):
        for pair in [*pairs]:
            if mode == "late" and isinstance(pair.rival, Sleeps):
                continue
            key = (pair.rival.name, pair.rival.length)
            try:
                both = pair.measure(mode, seconds)
            except (RuntimeError, EOFError, OSError) as error:
                if isinstance(pair.rival, PbonetTable | Sleeps):
                    raise
                why = str(error) or "one of its processes ended"
                told(f"{pair.rival.name}: skipped, {why}")
                found.pop(key, None)
                pairs.remove(pair)
                pair.close()
                continue
            figures = found.setdefault(key, Figures({}))
            figures.blocks.setdefault(mode, []).append(both)
