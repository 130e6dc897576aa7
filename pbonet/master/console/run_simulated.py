"""A whole job in virtual time, in this process and without devices."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any, Final

from pbonet.master.sim import Simulation, sim_log

from . import summary
from .run_end import Interrupts, Outcome

if TYPE_CHECKING:
    from pathlib import Path

    from pbonet.master.configuration import Place
    from pbonet.master.sim import SimLog

    from .live_status import View

_SECONDS: Final = 10.0
_SLICE: Final = 0.05
"""Seconds of virtual time between two checks whether to end."""


def recorded(
    path: str | Path,
    place: Place,
    view: View,
    seconds: float | None,
    *,
    record: str | None,
    runs: str | Path | None,
) -> Outcome:
    """Simulate a job, with a log where a run in real time has one.

    Args:
        path: The ``.job`` file.
        place: Where RMODs and modules are found.
        view: The display.
        seconds: How much virtual time passes; None: 10 s.
        record: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None for what the job
            says.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.

    Raises:
        PbonetError: The job cannot be assembled, or not be recorded like that.
    """
    wanted = _SECONDS if seconds is None else seconds
    log = sim_log.begin(path, place, record=record, runs=runs, seconds=wanted)
    return simulate(path, place, view, wanted, log)


def simulate(
    path: str | Path,
    place: Place,
    view: View,
    seconds: float | None,
    log: SimLog | None = None,
) -> Outcome:
    """Run a job in virtual time, in this process and without devices.

    Args:
        path: The ``.job`` file.
        place: Where RMODs and modules are found.
        view: The display.
        seconds: How much virtual time passes; None: 10 s.
        log: Where it is recorded; without, every cycle is kept in memory.

    Raises:
        PbonetError: The job cannot be assembled.
    """
    wanted = _SECONDS if seconds is None else seconds
    simulation = Simulation(path, place.libraries, log)
    interrupts = Interrupts(once=True)
    begin, passed = time.monotonic(), 0.0
    try:
        with interrupts.caught():
            simulation.start()
            on = ", ".join(n for n, now in simulation.states().items() if now == "ON")
            view.say(f"job {simulation.job.name} is ON in virtual time: {on}")
            try:
                passed = _advance(simulation, wanted, interrupts)
                statuses = simulation.status()
            finally:
                simulation.stop()
    finally:
        if log is not None:
            log.end(simulation.now_ns, passed)
        simulation.close()
    for event in simulation.events:
        view.say(event)
    view.say(f"{passed:g} s of virtual time took {time.monotonic() - begin:.2f} s")
    about: dict[str, Any] = {"seconds": passed, "events": simulation.events}
    simulation.recording.about |= about
    return Outcome(
        job=simulation.job.name,
        seconds=passed,
        tasks=summary.summarize(statuses),
        reason="interrupted"
        if interrupts.count
        else f"{wanted:g} s of virtual time are over",
        faults=list(log.faults) if log is not None else [],
        log=str(log.folder) if log is not None and log.written else "",
        recording=simulation.recording if log is None else log.read(),
    )


def _advance(simulation: Simulation, seconds: float, interrupts: Interrupts) -> float:
    """Let virtual time pass until it is over or interrupted; return how much did."""
    begin_ns = simulation.now_ns
    end_ns = begin_ns + (round(seconds * 1e9) if math.isfinite(seconds) else math.inf)
    while simulation.now_ns < end_ns and not interrupts.wished.is_set():
        simulation.advance(min(_SLICE, (end_ns - simulation.now_ns) * 1e-9))
    return (simulation.now_ns - begin_ns) / 1e9
