"""Figure 6.1 for real: an overload under MUF, RM and EDF, beside the simulator.

    python examples/overload/demo.py [--quick]

Four tasks, T = (6, 10, 12, 15) and C = (2, 4, 3, 4) units of 3 ms, are real processes
that use real CPU time on one core: 96 % of C, and so 120 % of the core, in bursts of
0.72 s, because Linux throttles what stays above 95 %. For each scheduler it starts an
agent, runs the bursts, reads from the dispatcher's trace and the tasks' records what
really ran, and prints that below what the simulator says.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import judged
import seen
from judged import CONDUCTOR, SHARE, TASKS, UNIT_NS
from msgspec import Struct

from pbonet.analysis.schedule import chart
from pbonet.analysis.schedule.simulate import PeriodicTask, simulate
from pbonet.errors import NodeError, PbonetError
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import Run
from pbonet.master.subsystem.embedded_agents import assign_cores
from pbonet.node import rt

if TYPE_CHECKING:
    from pbonet.analysis.schedule.outcome import Outcome
    from pbonet.analysis.schedule.records import SlotStatus
    from pbonet.log import Cycles

HERE: Final = Path(__file__).parent
SCHEDULERS: Final = ("MUF", "RM", "EDF")
EXPECTED: Final = {
    "MUF": "only tau4 misses: tau1, tau2 and tau3 are the critical set",
    "RM": "tau1 and tau2 keep their deadlines, tau3 and tau4 miss",
    "EDF": "tasks other than tau4 miss; which ones cannot be predicted",
}
HYPERPERIOD_NS: Final = 60 * UNIT_NS
WORK, REST = 4, 2
"""Hyperperiods of a burst, and between two; `pulse.rmod` says the same."""
RTPU: Final = "overload0"
DOMAIN: Final = f"overload{os.getpid()}"


class Seen(Struct, kw_only=True):
    """What ran under one scheduler."""

    scheduler: str
    history: seen.History
    tasks: dict[str, SlotStatus]
    """tau1 to tau4."""
    bursts: list[tuple[int, int]]
    """Begin and end of those that are whole."""

    def real(self, burst: int) -> Outcome:
        """Return what ran in a burst, as the simulator says it."""
        return self.history.outcome(self.tasks, *self.bursts[burst])

    def simulated(self) -> Outcome:
        """Return a burst of the same set in virtual time, ranked as it was."""
        tasks = [
            PeriodicTask(
                name=name,
                period_ns=status.period_ns,
                cost=round(SHARE * TASKS[name][1] * UNIT_NS),
                crit=status.crit,
                priority=status.priority,
            )
            for name, status in self.tasks.items()
        ]
        return simulate(tasks, until_ns=WORK * HYPERPERIOD_NS)


class Lines:
    """Keeps what a run says; shown when it fails."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, line: str) -> None:
        """Keep a line."""
        self.said.append(line)

    def show(self, passed: float, rtpus: list[Any], events: list[Any]) -> None:
        """Show nothing: that tasks miss is what they are here for."""

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, *_: object) -> None:
        """End."""


def prepare(scheduler: str, folder: Path) -> Path:
    """Copy the files of a scheduler's job, and return the job."""
    for path in HERE.iterdir():
        if path.suffix in {".svar", ".sbs", ".job", ".rmod"}:
            shutil.copy(path, folder)
    return folder / f"{scheduler.lower()}.job"


def core() -> int:
    """Return the core on which the agent will be."""
    return assign_cores([RTPU], os.sched_getaffinity(0))[RTPU]


def run(scheduler: str, bursts: int) -> Seen:
    """Run some bursts under one scheduler.

    Raises:
        PbonetError: The job could not be run, or what ran could not be recorded.
    """
    lines = Lines()
    with tempfile.TemporaryDirectory() as folder, seen.Watcher(core()) as watcher:
        outcome = Run(
            prepare(scheduler, Path(folder)),
            Place(domain=DOMAIN, libraries=(str(HERE),)),
            lines,
            # It ends in the rest after the last burst, where its tasks obey at once.
            embed=HERE / "agent.toml",
            seconds=(bursts * (WORK + REST) + 1.5) * HYPERPERIOD_NS * 1e-9,
            runs=Path(folder, "runs"),
        ).run()
    if outcome.status or outcome.recording is None:
        raise NodeError("the run failed", got="\n".join([*lines.said, *outcome.faults]))
    strangers = {status.rtpu for status in watcher.slots.values()} - {
        f"{DOMAIN}/{RTPU}"
    }
    if strangers or watcher.lost or outcome.recording.lost():
        raise NodeError(
            "the core was not ours alone, or its trace is not complete",
            where=f"core {core()}",
            got=f"tasks of {', '.join(sorted(strangers)) or 'nobody else'}",
            remedy="end other agents on this core and try again",
        )
    return read(scheduler, watcher, outcome.recording)


def read(scheduler: str, watcher: seen.Watcher, recording: Cycles) -> Seen:
    """Return what ran, from the core's trace and the tasks' records.

    Raises:
        NodeError: There was not one whole burst.
    """
    ours = {slot: status.task.split("/")[-1] for slot, status in watcher.slots.items()}
    by_name = {ours[slot]: status for slot, status in watcher.slots.items()}
    bursts = whole_bursts(recording)
    if not bursts:
        raise NodeError(
            "no burst has run to its end",
            remedy="the machine stands still for long stretches; try another one",
        )
    return Seen(
        scheduler=scheduler,
        history=seen.history(watcher.trace, ours, seen.cycles_of(recording)),
        tasks={name: by_name[name] for name in TASKS},
        bursts=bursts,
    )


def whole_bursts(recording: Cycles) -> list[tuple[int, int]]:
    """Return begin and end of the bursts that have run to their end, as pulse wrote."""
    arrays = recording.arrays(CONDUCTOR)
    go, at = arrays["GO"].ravel().tolist(), arrays["release_ns"].tolist()
    found: list[tuple[int, int]] = []
    begin = 0
    for before, now, instant in zip([0, *go], go, at, strict=False):
        if now and not before:
            begin = instant
        elif before and not now and instant - begin == WORK * HYPERPERIOD_NS:
            found.append((begin, instant))
    return found


def report(one: Seen) -> tuple[list[str], judged.Judgement]:
    """Return what is to be printed about a scheduler, and the judgement."""
    judgement = judged.judge(one.history, one.scheduler, one.bursts)
    end, unit = HYPERPERIOD_NS, UNIT_NS
    virtual, first = one.simulated(), one.real(0)
    lines = [
        f"== {one.scheduler}: {EXPECTED[one.scheduler]}",
        "",
        "simulated",
        *chart.as_text(virtual, end_ns=end, unit_ns=unit).splitlines()[:-1],
        "",
        "real, the first burst",
        *chart.as_text(first, end_ns=end, unit_ns=unit).splitlines(),
        "",
        *table(one, virtual),
        "",
    ]
    lines += excuses(judgement)
    lines += [f"NOT as expected: {fault}" for fault in judgement.faults] or [
        "as expected"
    ]
    return [*lines, ""], judgement


def excuses(judgement: judged.Judgement) -> list[str]:
    """Return a line for each task with misses that do not count, and why they don't."""
    lines: list[str] = []
    for task in TASKS:
        ours = [miss for miss in judgement.misses if miss.task == task]
        overran = sum(miss.overran for miss in ours)
        away = [
            miss.away_ns / 1e6 for miss in ours if miss.excused and not miss.overran
        ]
        if overran:
            lines.append(
                f"{task}: {overran} do not count, it used more than its reserve"
            )
        if away:
            lines.append(
                f"{task}: {len(away)} do not count, {min(away):.1f} to {max(away):.1f} "
                "ms of the core went to others"
            )
    return lines


def table(one: Seen, virtual: Outcome) -> list[str]:
    """Return deadlines missed, simulated and real, and the CPU time of real cycles."""
    bursts = range(len(one.bursts))
    accounts = [one.real(burst).tasks for burst in bursts]
    rows: list[list[str]] = [
        ["", "criticality", "missed/deadlines simulated", "real", "CPU ms mean", "max"]
    ]
    for name, status in one.tasks.items():
        due = virtual.tasks[name].releases - 1  # the last one belongs to what follows
        cpu = [
            cycle.cpu_ns / 1e6
            for cycle in one.history.cycles[name]
            if any(b <= cycle.release_ns < e for b, e in one.bursts)
        ]
        missed = sum(account[name].missed for account in accounts)
        rows.append([
            name,
            str(status.crit),
            f"{virtual.tasks[name].missed * len(bursts)}/{due * len(bursts)}",
            f"{missed}/{due * len(bursts)}",
            f"{sum(cpu) / len(cpu):.3f}" if cpu else "-",
            f"{max(cpu):.3f}" if cpu else "-",
        ])  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]


def must_have_fifo() -> None:
    """End with the reason where the kernel gives no real-time priorities."""
    probe = rt.probe()
    if not probe.fifo:
        reasons = "\n".join(f"  {reason}" for reason in probe.reasons)
        sys.exit(
            "demo: this needs SCHED_FIFO, which the kernel refuses here: without it "
            f"nobody can say who has the core.\n{reasons}\n"
            "'pbonet doctor' says more; the simulator needs no right: "
            "'pbonet simulate examples/overload/muf.job --library examples/overload'"
        )


def main(argv: list[str] | None = None) -> None:
    """Run all three and print them."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument(
        "--quick", action="store_true", help="2 bursts each; 8 otherwise"
    )
    words.add_argument(
        "--scheduler", choices=SCHEDULERS, action="append", help="only this one"
    )
    told = words.parse_args(argv)
    must_have_fifo()
    faults = 0
    for scheduler in told.scheduler or SCHEDULERS:
        try:
            lines, judgement = report(run(scheduler, 2 if told.quick else 8))
        except PbonetError as error:
            sys.exit(f"demo: {scheduler}: {error}")
        sys.stdout.write("\n".join(lines) + "\n")
        sys.stdout.flush()
        faults += len(judgement.faults)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
