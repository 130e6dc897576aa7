"""Virtual time is one implementation: a job, a program and a log give the same bits."""

from __future__ import annotations

import gc
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from virtual_job import simulate

from pbonet.log import COLUMNS, Cycles, Log
from pbonet.master import Subsystem
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.shm import folder

EXAMPLES = Path(__file__).parents[3] / "examples"
JOBS = ["puma/puma", "servoing/inverse", "servoing/combined", "pick_and_place/descend"]
SECONDS = 1.0


def bits(cycles: Cycles) -> dict[str, bytes]:
    """Return every value of every cycle, and when it was released."""
    return {
        f"{task}/{name}": np.ascontiguousarray(values).tobytes()
        for task in cycles.tasks
        for name, values in cycles.arrays(task).items()
        if name in {*cycles.variables(task), COLUMNS[0]}
    }


@pytest.fixture(scope="module", params=JOBS)
def job(request: pytest.FixtureRequest) -> Path:
    return EXAMPLES / f"{request.param}.job"


@pytest.fixture(scope="module")
def simulated(job: Path) -> dict[str, bytes]:
    found = bits(simulate(job, SECONDS, [job.parent]))
    assert len(found) > 4
    return found


def test_a_program_gives_the_bits_of_a_job(job, simulated) -> None:
    with Subsystem(job, libraries=[job.parent], virtual=True) as subsystem:
        subsystem.start()
        begun = subsystem.simulation.now_ns
        subsystem.clock.wait(SECONDS, threading.Event())
        program = bits(subsystem.simulation.recording)
    assert begun == 1_000_000_000, "a start takes no virtual time"
    assert program == simulated


def test_its_log_has_the_bits(job, simulated, tmp_path) -> None:
    place = Place(libraries=(str(job.parent),))
    outcome = run(job, place, seconds=SECONDS, sim=True, runs=tmp_path, quiet=True)
    log = Log(outcome.log)
    assert bits(log) == simulated


def test_it_leaves_nothing_in_shared_memory(simulated) -> None:
    del simulated
    mine = f"pbonet.{os.geteuid()}.virtual{os.getpid()}"
    assert [path for path in folder().iterdir() if path.name.startswith(mine)] == []


def test_it_gives_its_files_back_without_waiting_for_the_collector(job) -> None:
    """But for the table's own, which modules have bound their arrays to."""
    gc.collect()
    gc.disable()
    try:
        counts = []
        for _ in range(4):
            simulate(job, 0.01, [job.parent])
            counts.append(len(list(Path("/proc/self/fd").iterdir())))
        assert counts[-1] - counts[0] <= 3, counts
    finally:
        gc.enable()
