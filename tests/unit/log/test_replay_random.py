"""What modules draw: numbers of the task are drawn again, others are named."""

from __future__ import annotations

import contextlib
import json
import os
import random
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
    (tmp_path / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nEOF\n")
    (tmp_path / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (tmp_path / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    (tmp_path / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (tmp_path / "x.svar").write_text(SVAR)

    def simulate(runs, code=OURS):
        (tmp_path / "adds.py").write_text(code)
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


SOURCES = [
    ("random.gauss(0, 1)", "random.gauss"),
    ("np.random.normal()", "numpy.random.normal"),
    ("np.random.default_rng().normal()", "numpy.random"),
    ("random.Random().random()", "random.Random"),
    ("random.SystemRandom().random()", "random.SystemRandom.random"),
    ("os.urandom(4)[0]", "os.urandom"),
    ("os.getrandom(4)[0]", "os.getrandom"),
    ("secrets.randbelow(1 << 30)", "secrets.randbelow"),
    ("uuid.uuid4().int % 9973", "uuid.uuid4"),
    ("int(np.fromfile('/dev/urandom', 'u1', 4)[1])", "/dev/urandom"),
    ("os.read(os.open(b'/dev/random', os.O_RDONLY), 4)[1]", "/dev/random"),
]


@pytest.mark.parametrize(("drawn", "name"), SOURCES)
def test_other_numbers_are_named(tmp_path, drawn, name) -> None:
    path = recorded(tmp_path, draws(drawn))
    line = draws(drawn).splitlines().index(f"        self.y[0] = {drawn}") + 1
    before = random.random, os.urandom, random.Random.seed, np.random.normal
    for verdict in [*verify(path, ["a"]), *rerun(path, ["a"]).tasks]:
        assert verdict.divergence is None
        (gap,) = verdict.gaps
        place = f"{tmp_path / 'adds.py'}:{line} in cycle"
        assert f"differs, but it uses {name} at {place}, whose numbers are in no" in gap
        assert "self.task.rng" in gap
        assert not verdict.good
    after = random.random, os.urandom, random.Random.seed, np.random.normal
    assert after == before


SEEDED = [
    ("random.random()", "random.seed(3)"),
    ("random.random()", "random.setstate(random.Random(3).getstate())"),
    ("np.random.normal()", "np.random.seed(3)"),
    ("self.made.random()", "random.Random(3)"),
    ("self.made.normal()", "np.random.default_rng(3)"),
]


@pytest.mark.parametrize(("drawn", "first"), SEEDED)
def test_what_a_module_seeds_is_no_chance(tmp_path, drawn, first) -> None:
    code = draws(drawn, first)
    path = recorded(tmp_path, code)
    (tmp_path / "adds.py").write_text(code.replace("self.z[0]", "self.z[1]"))
    (verdict,) = verify(path, ["a"])
    assert verdict.divergence is not None
    assert verdict.divergence.variable == "Y0"
    assert verdict.divergence.element == 1, "the seeded number is the same"


@pytest.mark.parametrize(
    ("own", "shared"),
    [
        (
            ("self.made.random()", "random.Random(3)"),
            ("random.random()", "random.seed(3)"),
        ),
        (
            ("self.made.random()", "np.random.RandomState(3)"),
            ("np.random.random()", "np.random.seed(3)"),
        ),
    ],
    ids=["random", "numpy"],
)
def test_each_task_has_the_shared_generator_for_itself(tmp_path, own, shared) -> None:
    """As in a recording of processes, which one of its own stands for here."""
    path = recorded(tmp_path, draws(*own))
    (tmp_path / "adds.py").write_text(draws(*shared))
    assert rerun(path).good, str(rerun(path))
    assert all(one.good for one in verify(path))


@pytest.mark.parametrize("first", ["np.random.default_rng()", "random.Random()"])
def test_a_generator_without_a_seed_is_named_where_it_is_made(tmp_path, first) -> None:
    path = recorded(tmp_path, draws("self.made.random()", first))
    (verdict,) = verify(path, ["a"])
    assert verdict.divergence is None
    assert " in init, whose numbers are in no log" in verdict.gaps[0]


def test_numbers_from_the_time_of_loading_are_named_in_each_life(tmp_path) -> None:
    code = draws("gauss(0, 1) + RNG.random()")
    code = code.replace("import os", "import os\nfrom random import Random, gauss", 1)
    code = code.replace("class Gain", "RNG = Random()\n\n\nclass Gain")
    path = recorded(tmp_path / "then", code)
    now = tmp_path / "now"  # this process has not loaded it
    now.mkdir()
    (now / "adds.py").write_text(code)
    for verdict in [*verify(path, libraries=[now]), *verify(path, libraries=[now])]:
        assert verdict.divergence is None
        assert f"random.Random at {now / 'adds.py'}:" in verdict.gaps[0]
        assert " in <module>, " in verdict.gaps[0]


def test_a_function_that_the_module_imports_by_name_is_watched(tmp_path) -> None:
    code = draws("gauss(0, 1)").replace("import random", "from random import gauss")
    path = recorded(tmp_path / "then", code)
    now = tmp_path / "now"
    now.mkdir()
    (now / "adds.py").write_text(code)
    (verdict,) = verify(path, ["a"], libraries=[now])
    assert "it uses random.gauss at " in verdict.gaps[0]


def test_a_simulation_that_draws_otherwise_is_not_verifiable(
    simulated, tmp_path
) -> None:
    log = simulated(tmp_path / "runs", draws("random.random()"))
    again = rerun(log)
    assert not again.good
    assert not again.first
    for verdict in [*again.tasks, *verify(log)]:
        assert verdict.divergence is None
        assert "but it uses random.random at " in verdict.gaps[0]


def test_the_verb_ends_with_the_status_of_what_cannot_be_verified(
    call, tmp_path
) -> None:
    path = recorded(tmp_path, draws("random.random()"))
    for words in (("--verify",), ()):
        status, out, _ = call("replay", path, "a", *words)
        assert status == 3
        assert "  not verifiable: cycle 1: Y0 differs, but it uses random.random" in out
