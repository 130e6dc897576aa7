"""Semaphores and queues of express mail beside what Linux and Python offer.

    python -m benchmarks.ipc [--rounds N] [--markdown FILE]

Every contestant runs in every round, one after the other, so that whatever else the
machine does hits all of them; shown are medians over the rounds, and half the distance
between the quartiles.

Contestants:
    pbonet      pbonet.xm.Semaphore and pbonet.xm.Queue
    POSIX       multiprocessing.Semaphore, which is sem_t behind a C call; mq_send and
                mq_receive by ctypes (posixmq.py), which is some 0.3 us of a call
    datagram    a pair of Unix datagram sockets, send and recv

Cases:
    P, V        one process, nobody waits
    send        one process: one message into the queue and out of it again
    ping-pong   two processes that wake each other in turn: one round trip
    waiting     processor time of a process that waits for 2 s and gets nothing
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import resource
import secrets
import socket
import statistics
import time
import timeit
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks import posixmq, rtbench
from pbonet import xm

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

CALLS, TRIPS = 5000, 500
SIZES = (16, 1024)
WAIT = 2.0
SLOWEST = 1.5
"""Of POSIX, within a round: goal of an uncontended P and V, and of a message."""


class Pair(NamedTuple):
    """What two processes wake each other with, seen from either."""

    first: tuple[Callable[[], object], Callable[[], object]]
    """Wake the other, and wait for it."""
    second: tuple[Callable[[], object], Callable[[], object]]


@contextlib.contextmanager
def pairs() -> Generator[dict[str, Pair], None, None]:
    """Yield each contestant of the ping-pong."""
    tag = secrets.token_hex(4)
    ours = [xm.semaphore(f"bench-{tag}-{n}", initial=0) for n in range(2)]
    queues = [xm.queue(f"bench-{tag}-{n}") for n in range(2)]
    theirs = [multiprocessing.Semaphore(0) for _ in range(2)]
    posix = [posixmq.Queue(16) for _ in range(2)]
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    data = bytes(16)
    try:
        yield {
            "pbonet semaphore": Pair((ours[0].v, ours[1].p), (ours[1].v, ours[0].p)),
            "POSIX semaphore": Pair(
                (theirs[0].release, theirs[1].acquire),
                (theirs[1].release, theirs[0].acquire),
            ),
            "pbonet queue, 16 B": Pair(
                (lambda: queues[0].send(data), queues[1].receive),
                (lambda: queues[1].send(data), queues[0].receive),
            ),
            "POSIX queue, 16 B": Pair(
                (lambda: posix[0].send(data), posix[1].receive),
                (lambda: posix[1].send(data), posix[0].receive),
            ),
            "datagram, 16 B": Pair(
                (lambda: ends[0].send(data), lambda: ends[0].recv(2048)),
                (lambda: ends[1].send(data), lambda: ends[1].recv(2048)),
            ),
        }
    finally:
        for end in ends:
            end.close()
        for rival in posix:
            rival.close()
        for made in (*ours, *queues):
            made.destroy()


def ping_pong(pair: Pair, cores: tuple[int, int]) -> float:
    """Return nanoseconds of a round trip between two processes on these cores."""
    free = os.sched_getaffinity(0)
    child = os.fork()
    wake, wait = pair.first if child else pair.second
    if not child:
        os.sched_setaffinity(0, {cores[1]})
        for _ in range(TRIPS + 10):
            wait()
            wake()
        os._exit(0)
    os.sched_setaffinity(0, {cores[0]})
    try:
        for _ in range(10):
            wake()
            wait()
        begin = time.perf_counter_ns()
        for _ in range(TRIPS):
            wake()
            wait()
        return (time.perf_counter_ns() - begin) / TRIPS
    finally:
        os.sched_setaffinity(0, free)
        os.waitpid(child, 0)


def measure(call: Callable[[], object]) -> float:
    """Return nanoseconds of one call."""
    return timeit.timeit(call, number=CALLS) / CALLS * 1e9


@contextlib.contextmanager
def calls() -> Generator[dict[str, dict[str, Callable[[], object]]], None, None]:
    """Yield the cases of one process: contestants by case."""
    tag = secrets.token_hex(4)
    ours = xm.semaphore(f"bench-{tag}", initial=1)
    binary = xm.semaphore(f"bench-{tag}-b", initial=1, binary=True)
    queue = xm.queue(f"bench-{tag}", block=1024)
    theirs = multiprocessing.Semaphore(1)
    posix = posixmq.Queue(max(SIZES))
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)

    def p_v(
        take: Callable[[], object], give: Callable[[], object]
    ) -> Callable[[], None]:
        def both() -> None:
            take()
            give()

        return both

    def through(data: bytes) -> dict[str, Callable[[], object]]:
        def ours() -> bytes | None:
            queue.send(data)
            return queue.receive()

        def socket_pair() -> bytes:
            ends[0].send(data)
            return ends[1].recv(2048)

        def posix_queue() -> bytes:
            posix.send(data)
            return posix.receive()

        return {"pbonet": ours, "POSIX": posix_queue, "datagram": socket_pair}

    try:
        yield {
            "P and V": {
                "pbonet": p_v(ours.p, ours.v),
                "pbonet binary": p_v(binary.p, binary.v),
                "POSIX": p_v(theirs.acquire, theirs.release),
            },
            **{f"send and receive {size} B": through(bytes(size)) for size in SIZES},
        }
    finally:
        posix.close()
        for end in ends:
            end.close()
        for made in (ours, binary, queue):
            made.destroy()


def waiting() -> float:
    """Return the processor time of a process that waits, as a share of a core."""
    queue = xm.queue(f"bench-{secrets.token_hex(4)}")
    read, write = os.pipe()
    child = os.fork()
    if not child:
        before = resource.getrusage(resource.RUSAGE_SELF)
        queue.receive(time.monotonic_ns() + int(WAIT * 1e9))
        after = resource.getrusage(resource.RUSAGE_SELF)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        os.write(write, repr(used).encode())
        os._exit(0)
    os.waitpid(child, 0)
    used = float(os.read(read, 100))
    os.close(read)
    os.close(write)
    queue.destroy()
    return used / WAIT


def run(rounds: int) -> dict[tuple[str, str], list[float]]:
    """Return nanoseconds by case and contestant, one of each round."""
    found: dict[tuple[str, str], list[float]] = {}
    first, *more = sorted(os.sched_getaffinity(0))
    places = {"one core": (first, first)}
    if more:
        places["two cores"] = (first, more[0])
    with calls() as cases, pairs() as players:
        for _ in range(rounds):
            for case, rivals in cases.items():
                for name, call in rivals.items():
                    found.setdefault((case, name), []).append(measure(call))
            for place, cores in places.items():
                for name, pair in players.items():
                    ns = ping_pong(pair, cores)
                    found.setdefault((f"ping-pong, {place}", name), []).append(ns)
    return found


def report(
    found: dict[tuple[str, str], list[float]], rounds: int, idle: float
) -> list[str]:
    """Return the table as Markdown."""
    lines = [
        "# Semaphores and queues",
        "",
        f"    python -m benchmarks.ipc --rounds {rounds}",
        "",
        f"{rtbench.machine()}; median of {rounds} rounds, nanoseconds, from Python.",
        "",
        "| case | contestant | ns | ± |",
        "|---|---|---|---|",
    ]
    for (case, name), values in found.items():
        quarter, median, three = statistics.quantiles(values, n=4)
        ns = f"**{median:.0f}**" if name.startswith("pbonet") else f"{median:.0f}"
        lines.append(f"| {case} | {name} | {ns} | {(three - quarter) / 2:.0f} |")
    lines.append("")
    for case in ("P and V", *(f"send and receive {size} B" for size in SIZES)):
        both = zip(found[case, "pbonet"], found[case, "POSIX"], strict=True)
        ratio = statistics.median(ours / theirs for ours, theirs in both)
        met = "met" if ratio <= SLOWEST else "NOT met"
        lines.append(f"- {case} at most {SLOWEST:g} x POSIX: {ratio:.2f}, **{met}**")
    return [
        *lines,
        f"- a process that waits uses {100 * idle:.3f} % of a core",
    ]


def main() -> None:
    """Run the benchmark and print its table; fail when the goal is missed."""
    parser = argparse.ArgumentParser(description="Semaphores and queues beside rivals.")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--markdown", type=Path, help="also write the table there")
    options = parser.parse_args()
    lines = report(run(options.rounds), options.rounds, waiting())
    rtbench.judge(lines, options.markdown)


if __name__ == "__main__":
    main()
