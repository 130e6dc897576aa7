"""A job or a sequence of jobs in virtual time, in this process and without devices."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Final

from pbonet.errors import SeveralError
from pbonet.master.sim import sim_log
from pbonet.master.subsystem import Subsystem

from . import run_sequence, summary
from .run_end import Interrupts, Outcome

if TYPE_CHECKING:
    from pathlib import Path

    from pbonet.master.configuration import Place
    from pbonet.master.sim import VirtualRtpus
    from pbonet.master.subsystem import SequenceState

    from .live_status import View

_SECONDS: Final = 10.0
_SLICE: Final = 0.05
"""Seconds of virtual time between two checks whether to end."""


def simulate(
    path: str | Path,
    place: Place,
    view: View,
    seconds: float | None,
    *,
    record: str | None,
    runs: str | Path | None,
) -> Outcome:
    """Run a job or a sequence in virtual time, with a log as in real time.

    Args:
        path: The ``.job`` or ``.seq`` file.
        place: Where RMODs and modules are found.
        view: The display.
        seconds: How much virtual time passes; None: 10 s, or until the sequence ends.
        record: ``off`` to keep every cycle in memory, ``outputs``, ``all`` or ``last
            SECONDS``; None for what the job says.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.

    Raises:
        PbonetError: The job cannot be assembled, or not be recorded like that.
    """
    warnings: list[str] = []
    subsystem = Subsystem(
        path, libraries=place.libraries, virtual=True, warned=warnings.append
    )
    simulation = subsystem.simulation
    assert simulation is not None  # noqa: S101 - it is virtual
    files = subsystem.files
    job = files.recorded_job().name
    longest = _SECONDS if files.seq is None else math.inf
    wanted = longest if seconds is None else seconds
    log = sim_log.begin(files, record=record, runs=runs, seconds=wanted)
    interrupts = Interrupts(once=True)
    begin, passed = time.monotonic(), 0.0
    sequence: SequenceState | None = None
    try:
        with interrupts.caught():
            subsystem.open()
            if log is not None:
                simulation.log, simulation.epoch_ns = log, log.epoch_ns
            try:
                if files.seq is None:
                    _start(subsystem, job, view)
                    passed = _advance(simulation, wanted, interrupts)
                else:
                    first = simulation.now()
                    sequence = run_sequence.in_virtual_time(
                        subsystem, seconds, view.say, interrupts.wished
                    )
                    passed = simulation.now() - first
                statuses = subsystem.rtpu_status()
            finally:
                failures = _stop(subsystem)
    finally:
        if log is not None:
            log.end(simulation.now_ns, passed)
        subsystem.detach()
        simulation.close()
    events = [*warnings, *simulation.events]
    for event in events:
        view.say(event)
    view.say(f"{passed:g} s of virtual time took {time.monotonic() - begin:.2f} s")
    simulation.recording.about |= {"seconds": passed, "events": events}
    reason = f"{wanted:g} s of virtual time are over"
    if sequence is not None:
        reason = run_sequence.reason(sequence)
        failures += run_sequence.faults(sequence)
    return Outcome(
        job=job,
        seconds=passed,
        tasks=summary.summarize(statuses),
        reason="interrupted" if interrupts.count else reason,
        sequence=sequence,
        faults=failures + (log.faults if log is not None else []),
        log=str(log.folder) if log is not None and log.written else "",
        recording=simulation.recording if log is None else log.read(),
    )


def _start(subsystem: Subsystem, job: str, view: View) -> None:
    subsystem.start()
    on = ", ".join(task.name for task in subsystem.model if task.is_on)
    view.say(f"job {job} is ON in virtual time: {on}")


def _stop(subsystem: Subsystem) -> list[str]:
    """Stop the tasks; return what failed in it."""
    try:
        subsystem.stop()
    except SeveralError as error:
        return [str(one) for one in error.errors]
    return []


def _advance(simulation: VirtualRtpus, seconds: float, interrupts: Interrupts) -> float:
    """Let virtual time pass until it is over or interrupted; return how much did."""
    begin_ns = simulation.now_ns
    end_ns = begin_ns + (round(seconds * 1e9) if math.isfinite(seconds) else math.inf)
    while simulation.now_ns < end_ns and not interrupts.wished.is_set():
        left = (end_ns - simulation.now_ns) * 1e-9
        simulation.wait(min(_SLICE, left), interrupts.wished)
    return (simulation.now_ns - begin_ns) / 1e9
