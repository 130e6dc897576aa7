"""What modules draw: numbers of the task are drawn again, others are named."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys

import numpy as np
import pytest
from adding_module import SVAR
from drawing_module import draws
from log_of_python_tasks import RMOD, Shop

from pbonet.log import Did, Log
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.testing import rerun, verify

OURS = draws("self.task.rng.normal()")


def recorded(folder, code, cycles=5):
    """Return the log of some cycles of two tasks."""
    folder.mkdir(exist_ok=True)
    with contextlib.closing(Shop(folder, code)) as shop:
        shop.cycles(cycles)
        return shop.log()


def test_numbers_of_the_task_are_drawn_again(tmp_path) -> None:
    path = recorded(tmp_path, OURS)
    log = Log(path)
    drawn = log.arrays("a")["Y0"][:, 0]
    assert len(set(drawn)) == 5
    assert not np.array_equal(drawn, log.arrays("b")["Y1"][:, 0]), "another seed"
    assert all(one.good for one in verify(path))
    assert rerun(path).good


def test_they_continue_through_signals_and_start_anew_after_an_abort(tmp_path) -> None:
    code = draws("self.made.normal()", first="self.task.rng")
    with contextlib.closing(Shop(tmp_path, code)) as shop:
        a = shop.a
        shop.cycles(2)
        a.do(Did("reinit"), a.executor.signal, "reinit")
        a.signal("off")
        a.signal("on")
        shop.cycles(2)
        a.executor.instance.made.normal(size=7)  # of a cycle that did not end
        a.do(Did("abort", calls=a.tape.calls()), a.executor.abort)
        shop.cycles(2)
        path = shop.log()
    assert len(set(Log(path).arrays("a")["Y0"][:, 0])) == 6
    assert verify(path, ["a"])[0].good, str(verify(path, ["a"])[0])


@pytest.fixture
def simulated(tmp_path):
    """Return what simulates two tasks of the module, and returns the log."""
    (tmp_path / "adds.py").write_text(OURS)
    (tmp_path / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nEOF\n")
    (tmp_path / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (tmp_path / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    (tmp_path / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (tmp_path / "x.svar").write_text(SVAR)

    def simulate(runs):
        place = Place(libraries=(str(tmp_path),))
        job = tmp_path / "x.job"
        outcome = run(job, place, seconds=0.1, sim=True, runs=runs, quiet=True)
        return outcome.log

    return simulate


def test_virtual_time_draws_the_same_each_time(simulated, tmp_path) -> None:
    log = simulated(tmp_path / "one")
    then = [Log(log).arrays(task)["Y" if task == "a" else "X"] for task in "ab"]
    assert not np.array_equal(*(one[:, 0] for one in then))
    again = Log(simulated(tmp_path / "two"))
    assert np.array_equal(again.arrays("a")["Y"], then[0])
    assert all(one.good for one in verify(log))
    assert rerun(log).good


def test_a_module_that_draws_nothing_loads_no_generator() -> None:
    code = (
        "import json, sys\n"
        "import pbonet.node.task, pbonet.testing\n"
        "from pbonet.pbo import TaskContext\n"
        "task = TaskContext(seed=3)\n"
        "task.restart_rng()\n"
        "loaded = ['numpy.random' in sys.modules]\n"
        "first = task.rng.integers(1 << 30)\n"
        "print(json.dumps([*loaded, 'numpy.random' in sys.modules]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == [False, True]
