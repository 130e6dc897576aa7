"""Response times of aperiodic events: six policies, simulated and in real execution.

The policies of section 6.5 of Stewart 1994 on one task set: three periodic tasks (20,
50 and 90 ms) that use half or four fifths of the core, and Poisson events of 1 ms on
average that ask for 30 % of what is left. A server has the largest capacity in 20 ms
that the exact test allows, with what a cycle of each task costs beyond its work taken
into account (`SPARE`). Under MUF the tasks are the critical set and EDF orders them;
under RM their rates do. Every policy gets the same events, from a fixed seed.

*simulated* is `simulate`. *real* are processes under the dispatcher on one
core, which spend their CPU time in Python; another process, on another core, writes the
events into a pipe when their time has come, and a response time runs from that to the
end of the event's cycle. Polling has no task type of its own: it is a periodic task
that looks into the pipe in each cycle and serves what is there within its capacity.

    python -m benchmarks.aperiodic [--seconds 8] [--blocks 1] [--core 1] [--simulate]
        [--policies NAME ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import struct
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import structs

from benchmarks import rtbench
from pbonet.analysis.schedule import criticality
from pbonet.analysis.schedule.analysis import Demand, largest_server
from pbonet.analysis.schedule.records import Kind
from pbonet.analysis.schedule.servers import Server, ServerKind
from pbonet.analysis.schedule.simtasks import BACKGROUND, SERVER
from pbonet.analysis.schedule.simulate import (
    PeriodicTask,
    ServerTask,
    poisson,
    simulate,
)
from pbonet.node import rt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MS = 1_000_000
SECOND = 1000 * MS
SERVER_PERIOD = 20 * MS
SPARE = 200_000
"""Nanoseconds by which the test takes a task's cycle to be longer than it is."""
EVENT = struct.Struct("=qqq")
"""Number (-1 ends the server), CPU nanoseconds, the instant of writing."""
LEAD = SECOND // 2
"""Nanoseconds at least from the start of the generator to the events' origin."""
HYPERPERIOD = 900 * MS
"""After it the pattern of releases repeats; the events begin with one, as simulated."""


class Policy(NamedTuple):
    """How events are served."""

    kind: ServerKind
    rm: bool
    task_kind: Kind
    """The task type that does it."""


POLICIES = {
    "background": Policy(ServerKind.BACKGROUND, rm=False, task_kind=Kind.BACKGROUND),
    "polling (MUF)": Policy(ServerKind.POLLING, rm=False, task_kind=Kind.PERIODIC),
    "RDS": Policy(ServerKind.DEFERRABLE, rm=True, task_kind=Kind.DEFERRABLE),
    "RSS": Policy(ServerKind.SPORADIC, rm=True, task_kind=Kind.SPORADIC),
    "MDS": Policy(ServerKind.DEFERRABLE, rm=False, task_kind=Kind.DEFERRABLE),
    "MSS": Policy(ServerKind.SPORADIC, rm=False, task_kind=Kind.SPORADIC),
}


class Plan(NamedTuple):
    """One policy with its numbers."""

    policy: Policy
    tasks: list[Demand]
    crits: list[int]
    server_crit: int
    server_drop: int
    capacity_ns: int
    events: list[tuple[int, int]]


def demands(load: float) -> list[Demand]:
    """Return three tasks that use `load` of the core."""
    shares = {20: 0.4, 50: 0.35, 90: 0.25}
    return [
        Demand(
            name=f"T{period}",
            period_ns=period * MS,
            cost_ns=round(load * share * period * MS),
        )
        for period, share in shares.items()
    ]


def arrivals(load: float, until_ns: int) -> list[tuple[int, int]]:
    """Return events that ask for 30 % of what `load` leaves, 1 ms each on average."""
    draw = partial(random.Random(7).expovariate, 1.0)
    rate = 0.3 * (1 - load) / 1e-3
    return list(poisson(draw, rate, lambda: max(1000, round(draw() * MS)), until_ns))


def plan(load: float, policy: Policy, seconds: float) -> Plan:
    """Return criticalities as the runtime gives them, and the capacity."""
    tasks = demands(load)
    capacity = 0
    if policy.kind is not ServerKind.BACKGROUND:
        room = Server(kind=policy.kind, capacity_ns=0, period_ns=SERVER_PERIOD)
        real = [structs.replace(t, cost_ns=t.cost_ns + SPARE) for t in tasks]
        capacity = largest_server(room, real, rm=policy.rm)
    own, server = [criticality.INSIDE] * len(tasks), SERVER
    if policy.rm:
        own = [criticality.rm(SECOND / task.period_ns) for task in tasks]
        server = criticality.RM_LEVELS
    drop = criticality.dropped(server, fixed_rates=policy.rm, server=True)
    if policy.kind is ServerKind.BACKGROUND:
        server = drop = BACKGROUND
    events = arrivals(load, round(seconds * SECOND))
    return Plan(policy, tasks, own, server, drop, capacity, events)


class Responses(NamedTuple):
    """Response times in nanoseconds, and what the periodic tasks missed."""

    times: NDArray[np.int64]
    missed: int


def virtually(one: Plan, seconds: float) -> Responses:
    """Return response times in virtual time."""
    server = ServerTask(
        name="server",
        kind=one.policy.kind,
        arrivals=one.events,
        capacity_ns=one.capacity_ns,
        period_ns=SERVER_PERIOD,
        crit=one.server_crit,
        drop_crit=one.server_drop,
    )
    made = [
        PeriodicTask(
            name=task.name, period_ns=task.period_ns, cost=task.cost_ns, crit=crit
        )
        for task, crit in zip(one.tasks, one.crits, strict=True)
    ]
    until = round((seconds + 1) * SECOND)
    outcome = simulate(made, [server], until_ns=until, keep=False)
    accounts = outcome.tasks.values()
    return Responses(
        np.array(outcome.tasks["server"].responses_ns),
        sum(account.missed + account.late for account in accounts),
    )


def spend(until_ns: int) -> None:
    """Use CPU time up to an instant of the thread's CPU clock."""
    while time.thread_time_ns() < until_ns:
        pass


def send(pipe: int, events: Sequence[tuple[int, int]], core: int) -> None:
    """Write the events when their time has come, away from `core`, then end."""
    others = os.sched_getaffinity(0) - {core}
    os.sched_setaffinity(0, others or {core})
    rt.set_timer_slack()
    begin = -(-(time.monotonic_ns() + LEAD) // HYPERPERIOD) * HYPERPERIOD
    for number, (at, cost) in enumerate(events):
        time.sleep(max(0, begin + at - time.monotonic_ns()) * 1e-9)
        os.write(pipe, EVENT.pack(number, cost, time.monotonic_ns()))
    os.write(pipe, EVENT.pack(-1, 0, 0))


def start_sender(pipe: int, events: Sequence[tuple[int, int]], core: int) -> int:
    """Run `send` in a process of its own; return its pid."""
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            send(pipe, events, core)
            status = 0
        finally:
            os._exit(status)
    return pid


def start_tasks(core: rt.CoreTable, one: Plan) -> dict[int, int]:
    """Start the periodic tasks; pids by slot."""
    started: dict[int, int] = {}
    for task, crit in zip(one.tasks, one.crits, strict=True):
        slot = core.alloc("bench", task.name)
        core.configure(slot, period_ns=task.period_ns, crit=crit)

        def body(end: rt.Slot, cost: int = task.cost_ns) -> None:
            clock = time.thread_time_ns
            end.run(lambda _dt: spend(clock() + cost), None)

        started[slot] = rtbench.start_task(core, slot, body)
    return started


def poll(end: rt.Slot, capacity: int, pipe: int, out: NDArray[np.int64]) -> None:
    """Serve what has come, in each period for as long as the capacity lasts."""
    os.set_blocking(pipe, False)
    clock = time.thread_time_ns
    number = rest = written = 0

    def cycle(_dt: float) -> None:
        nonlocal number, rest, written
        until = clock() + capacity
        while (left := until - clock()) > 0:
            if not rest:
                try:
                    number, rest, written = EVENT.unpack(os.read(pipe, EVENT.size))
                except BlockingIOError:
                    return
            if number < 0:
                out[-1] = 1
                return
            now = min(rest, left)
            spend(clock() + now)
            rest -= now
            if not rest:
                out[number] = time.monotonic_ns() - written

    end.run(cycle, None)


def start_server(
    core: rt.CoreTable, one: Plan, kind: Kind, pipe: int, out: NDArray[np.int64]
) -> tuple[int, int]:
    """Start the server; its slot and pid. `out` gets the response times."""
    slot = core.alloc("bench", "server")
    core.configure(slot, kind=kind, crit=one.server_crit, drop=one.server_drop)
    spare = SPARE if kind is Kind.PERIODIC else 0  # it keeps to its capacity itself
    core.configure(slot, period_ns=SERVER_PERIOD, maxc_ns=one.capacity_ns + spare)

    def body(end: rt.Slot) -> None:
        if kind is Kind.PERIODIC:
            poll(end, one.capacity_ns, pipe, out)
            return
        clock, event = time.thread_time_ns, (0, 0, 0)

        def sync() -> None:
            nonlocal event
            event = EVENT.unpack(os.read(pipe, EVENT.size))

        def cycle(_dt: float) -> None:
            number, cost, written = event
            if number < 0:
                out[-1] = 1
            else:
                spend(clock() + cost)
                out[number] = time.monotonic_ns() - written

        end.run(cycle, None, sync=sync)

    return slot, rtbench.start_task(core, slot, body)


def really(core: rt.CoreTable, one: Plan, kind: Kind, seconds: float) -> Responses:
    """Return response times in real execution."""
    here, there = os.pipe()
    with tempfile.TemporaryFile() as file:
        shape = (len(one.events) + 1,)
        out = np.memmap(file, dtype=np.int64, mode="w+", shape=shape)
        out[:] = 0
        slot, server = start_server(core, one, kind, here, out)
        tasks = start_tasks(core, one)
        sender = start_sender(there, one.events, core.core)
        rtbench.wait_for(lambda: bool(out[-1]), "all events", 20 + 2 * seconds)
        os.waitpid(sender, 0)
        missed = sum(core.snapshot(k).missed + core.snapshot(k).late for k in tasks)
        for k, pid in tasks.items():
            rtbench.end_task(core, k, pid)
        core.request(slot)
        os.write(there, EVENT.pack(-1, 0, 0))
        rtbench.end_task(core, slot, server)
        times = np.array(out[:-1])
    os.close(here)
    os.close(there)
    return Responses(times, missed)


def line(name: str, how: str, capacity: int, blocks: Sequence[Responses]) -> str:
    """Return a line of the table, in milliseconds."""
    means = [float(block.times.mean()) / MS for block in blocks]
    every = np.concatenate([block.times for block in blocks]) / MS
    p50, p99, most = np.quantile(every, [0.5, 0.99, 1.0])
    return (
        f"{name:14} {how:9} {capacity / MS:8.3f} {rtbench.spread(means, 3)} "
        f"{p50:8.3f} {p99:8.3f} {most:8.3f} {sum(b.missed for b in blocks):7}"
    )


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Response of aperiodic events.")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--blocks", type=int, default=1)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--simulate", action="store_true", help="leave the real runs")
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=POLICIES)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    core = rt.CoreTable(args.core)
    dispatcher = rt.Dispatcher(core)
    result: dict[str, object] = {"machine": rtbench.machine()}
    print(rtbench.machine())
    try:
        dispatcher.start()
        for load in (0.5, 0.8):
            count = len(arrivals(load, round(args.seconds * SECOND)))
            print(f"\nU = {load}, {count} events, response times in ms")
            print(
                "policy         how       capacity      mean [least, greatest]"
                "           p50      p99      max  misses"
            )
            for name in args.policies:
                policy = POLICIES[name]
                one = plan(load, policy, args.seconds)
                found = {"simulated": [virtually(one, args.seconds)]}
                if not args.simulate:
                    found["real"] = [
                        really(core, one, policy.task_kind, args.seconds)
                        for _ in range(args.blocks)
                    ]
                for how, blocks in found.items():
                    print(line(name, how, one.capacity_ns, blocks), flush=True)
                    result[f"{load} {name} {how}"] = [
                        float(block.times.mean()) / MS for block in blocks
                    ]
        print(
            f"\nthe core stood still for more than 20 ms {core.status().stalls} times"
        )
    finally:
        dispatcher.stop()
        core.close()
    if args.json:
        args.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
