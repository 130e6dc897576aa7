"""How fast virtual time passes: seconds simulated by seconds taken.

Measures `pbonet.sched.simulate` (segments and response times kept) on sets of ten tasks
at and around 100 Hz, without module code; beside it the twin of the dispatcher, which
keeps every decision (`pbonet.sched.inline`), and the whole of `simulate_job`. The
median of five runs; the goal is 100 for the first line.

Then the mean response time of aperiodic events, in virtual time, for the policies of
section 6.5 of Stewart 1994: Poisson events of 1 ms on average that ask for 30 % of
what three periodic tasks leave, served with the largest capacity that the exact test
allows. Every policy gets the same events, and no periodic task misses.

    python -m benchmarks.simulate [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
import random
import statistics
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet import verify
from pbonet.config.model import Rmod, RtpuEntry, SvarFile
from pbonet.sched.analysis import Demand, largest_server
from pbonet.sched.inline import Inline
from pbonet.sched.servers import Server, ServerKind
from pbonet.sched.simulate import PeriodicTask, ServerTask, poisson, simulate

if TYPE_CHECKING:
    from collections.abc import Callable

MS = 1_000_000
SECOND = 1000 * MS
GOAL = 100
RUNS = 5


def tasks(spread_ns: int, cost_ns: int = 700_000) -> list[PeriodicTask]:
    """Return ten tasks of 100 Hz, their periods `spread_ns` apart."""
    return [
        PeriodicTask(
            name=f"t{k}", period_ns=10 * MS + k * spread_ns, cost=cost_ns, priority=k
        )
        for k in range(10)
    ]


def speed(run: Callable[[], object], seconds: float) -> float:
    """Return virtual seconds by real ones, the median of several runs."""
    found: list[float] = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        run()
        found.append(seconds / (time.perf_counter() - begin))
    return statistics.median(found)


def twin(spread_ns: int, seconds: int) -> None:
    """Run the same tasks by the twin of the dispatcher."""
    core = Inline(SECOND)
    for task in tasks(spread_ns):
        core.add(task.name, lambda _now, _dt: 700_000, period_ns=task.period_ns, crit=5)
        core.on(task.name)
    core.run_until((seconds + 1) * SECOND)


def job(seconds: float) -> None:
    """Run a configuration of ten tasks, from its verification data to the text."""
    made = [
        verify.Task(
            rmod=Rmod(name=f"t{k}", file="t.rmod", module="m", freq=100.0, maxc=0.0007),
            rtpu="arm0",
        )
        for k in range(10)
    ]
    configuration = verify.Configuration(
        svar=SvarFile(file="a.svar", defines={}, variables=()),
        tasks=tuple(made),
        on=frozenset(task.name for task in made),
        rtpus=(RtpuEntry(name="arm0"),),
    )
    verify.simulate_job(configuration, seconds=seconds).as_text()


def speeds() -> dict[str, float]:
    """Return how much faster than real time each case runs."""
    seconds = 20
    return {
        "10 tasks at 100 Hz": speed(
            lambda: simulate(tasks(0), until_ns=seconds * SECOND), seconds
        ),
        "10 tasks around 100 Hz": speed(
            lambda: simulate(tasks(1000), until_ns=seconds * SECOND), seconds
        ),
        "10 tasks at 100 Hz, simulate_job with its text": speed(
            lambda: job(seconds), seconds
        ),
        "10 tasks at 100 Hz, twin of the dispatcher": speed(
            lambda: twin(0, seconds // 4), seconds // 4
        ),
    }


POLICIES = {
    "background": (ServerKind.BACKGROUND, False),
    "polling (MUF)": (ServerKind.POLLING, False),
    "RDS": (ServerKind.DEFERRABLE, True),
    "RSS": (ServerKind.SPORADIC, True),
    "MDS": (ServerKind.DEFERRABLE, False),
    "MSS": (ServerKind.SPORADIC, False),
}
"""Kind of server, and whether RM schedules the tasks, not MUF."""
SERVER_PERIOD = 20 * MS


def periodic_tasks(load: float) -> list[Demand]:
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


def events(load: float, until_ns: int) -> list[tuple[int, int]]:
    """Return events that ask for 30 % of what `load` leaves, 1 ms each on average."""
    draw = partial(random.Random(7).expovariate, 1.0)
    rate = 0.3 * (1 - load) / 1e-3
    return list(poisson(draw, rate, lambda: max(1000, round(draw() * MS)), until_ns))


def serve(load: float, kind: ServerKind, *, rm: bool, seconds: int = 200) -> float:
    """Return the mean response time of the events in ms; NaN without any capacity."""
    asked = periodic_tasks(load)
    capacity = 0
    if kind is not ServerKind.BACKGROUND:
        room = Server(kind=kind, capacity_ns=0, period_ns=SERVER_PERIOD)
        capacity = largest_server(room, asked, rm=rm)
        if not capacity:
            return math.nan
    server = ServerTask(
        name="server",
        kind=kind,
        arrivals=events(load, seconds * SECOND),
        capacity_ns=capacity,
        period_ns=SERVER_PERIOD,
        crit=62 if rm else 6,
        drop_crit=None if rm else 4,
    )
    made = [
        PeriodicTask(
            name=one.name,
            period_ns=one.period_ns,
            cost=one.cost_ns,
            crit=50 - place if rm else 5,
        )
        for place, one in enumerate(asked)
    ]
    outcome = simulate(made, [server], until_ns=seconds * SECOND, keep=False)
    if outcome.missing:
        raise SystemExit(f"{kind.value}: {outcome.missing} missed deadlines")
    return statistics.fmean(outcome.tasks["server"].responses_ns) / MS


def main() -> int:
    """Measure, print, and say whether the goal was met."""
    parser = argparse.ArgumentParser(description="Speed of virtual time.")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    arguments = parser.parse_args()
    found = {"times real time": speeds()} | {
        f"mean response in ms at U = {load}": {
            name: serve(load, kind, rm=rm) for name, (kind, rm) in POLICIES.items()
        }
        for load in (0.5, 0.8)
    }
    for title, rows in found.items():
        print(title)
        for name, value in rows.items():
            print(f"  {name:50} {value:10.3g}")
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=1), encoding="utf-8")
    return 0 if found["times real time"]["10 tasks at 100 Hz"] >= GOAL else 1


if __name__ == "__main__":
    raise SystemExit(main())
