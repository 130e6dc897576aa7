"""Old data through a chain of tasks in virtual time, and what the robot does then.

A sensor on one RTPU stops measuring between two of its cycles, and goes on committing,
as a link or a driver that has lost its device does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pbonet import State
from pbonet.log import HELD, SAFE, STABLE, Log
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.testing import verify

MODULES = {
    "sensor": '''
class When(Params):
    """When it measures nothing."""

    first: A[int, param("1", "first cycle without a measurement")] = 50
    last: A[int, param("1", "last cycle without a measurement")] = 80


class Sensor(PortBasedObject[When]):
    """Count."""

    y: A[float, OutVar("S", "1", "none", "count")]

    def cycle(self, dt: float) -> None:
        count = self.task.cyclecount
        if not self.params.first <= count <= self.params.last:
            self.y += 1.0
            self.task.stamp_ns = self.task.now
''',
    "between": '''
class Between(PortBasedObject):
    """Pass on."""

    z: A[float, InVar("Z", "1", "none", "heard", max_age=0.5)]
    q: A[float, InVar("Q", "1", "none", "measured")]
    y: A[float, OutVar("Y", "1", "none", "told")]

    def cycle(self, dt: float) -> None:
        self.y = self.z
''',
    "robot": '''
class Robot(PortBasedObject):
    """Do what is told."""

    u: A[float, InVar("U", "1", "none", "told", max_age=0.05)]
    q: A[float, OutVar("Q", "1", "none", "measured", new=True, safe=-2.0)]
    age: A[float, OutVar("AGE", "1", "none", "age of U", new=True, safe=0.0)]

    def cycle(self, dt: float) -> None:
        self.q = self.u
        self.age = self.task.age("u")

    def stable(self, dt: float) -> None:
        self.q = -1.0
''',
}
HEAD = '''"""Part of a chain."""

from typing import Annotated as A

from pbonet import InVar, OutVar, Params, PortBasedObject, param

'''
RMOD = (
    "MODULE {}\nDESC d\n{}INCONST none\nOUTCONST none\nINVAR {}\nOUTVAR {}\n"
    "TASKTYPE periodic\nFREQ 100\n{}EOF\n"
)
TASKS = {
    "sensor": ("sensor", "", "none", "S"),
    "near": ("between", "SVARALIAS Z=S\nSVARALIAS Y=M\n", "Z Q", "Y"),
    "far": ("between", "SVARALIAS Z=M\nSVARALIAS Y=U\n", "Z Q", "Y"),
    "robot": ("robot", "", "U", "Q AGE"),
}
VARIABLE = "NAME {}\nTYPE double\nDESC d\nUNITS none\nNELEM 1\n\n"


def ran(
    folder: Path, more: str, modules: dict[str, str] = MODULES
) -> tuple[dict[str, np.ndarray], Path, list[dict[str, object]]]:
    """Run the chain; return the robot's cycles, the log, and the events."""
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(HEAD + text)
    for name, (module, alias, ins, outs) in TASKS.items():
        rmod = RMOD.format(module, alias, ins, outs, more * (name == "robot"))
        (folder / f"{name}.rmod").write_text(rmod)
    names = ("S", "M", "U", "Q", "AGE")
    (folder / "x.svar").write_text("".join(map(VARIABLE.format, names)) + "EOF\n")
    (folder / "x.sbs").write_text(
        "SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nRTPU s\nRTPU t\nEOF\n"
    )
    (folder / "x.job").write_text(
        "JOB x\nDESC\nSBS x.sbs\nTASK sensor r\nTASK near s\nTASK far s\n"
        "TASK robot t\nEOF\n"
    )
    outcome = run(
        folder / "x.job",
        Place(libraries=(str(folder),)),
        seconds=2.0,
        sim=True,
        runs=folder / "runs",
        quiet=True,
    )
    log = Log(outcome.log)
    return log.arrays("robot"), outcome.log, list(log.events())


def flags(robot, bit: int) -> np.ndarray:
    return np.flatnonzero(robot["flags"] & bit)


@pytest.mark.parametrize(
    ("more", "bit"),
    [("CRITICAL\n", STABLE), ("STALE hold\n", HELD), ("STALE safe\n", SAFE)],
)
def test_the_robot_reacts_to_the_age_of_the_sensor_two_tasks_away(
    tmp_path, more, bit
) -> None:
    robot, log, _ = ran(tmp_path, more)
    acted = flags(robot, bit)
    assert acted.size, "it did something else than cycle"
    started = acted[acted > 10]
    assert 53 <= started[0] <= 57, "50 ms after the last measurement"
    assert 82 <= started[-1] <= 88, "it goes on when the sensor has measured again"
    assert np.array_equal(started, np.arange(started[0], started[-1] + 1)), (
        "there is no flutter"
    )
    ages = np.delete(robot["AGE"].ravel(), acted)
    assert ages[10:].max() <= 0.05, "it acts on nothing older in cycle"
    q = robot["Q"].ravel()[started]
    assert set(q) == {{STABLE: -1.0, SAFE: -2.0, HELD: q[0]}[bit]}
    for verdict in verify(log):
        assert not verdict.divergence
        assert not verdict.gaps
        assert verdict.cycles == verdict.recorded == 200


def test_an_input_that_is_too_old_can_be_an_error(tmp_path) -> None:
    robot, _, events = ran(tmp_path, "STALE error\n")
    assert len(robot["cycle"]) < 60
    told = " ".join(str(one["text"]) for one in events)
    assert "the input U is too old (expected at most 0.05 s, got 0.06 s)" in told


def test_the_declared_time_passes_before_it_goes_on(tmp_path) -> None:
    robot, _, _ = ran(tmp_path, "CRITICAL\nSTALE stable 0.3\n")
    assert 109 <= flags(robot, STABLE)[-1] <= 116


def test_stable_that_answers_old_inputs_does_not_lock_the_chain(tmp_path) -> None:
    """The robot's answer is an input of those for whose output it waits.

    It says when it has measured, in `cycle` only: what `stable` wrote would be as old
    as the last cycle, and all of the circle would wait for each other.
    """
    robot = MODULES["robot"].replace(
        "        self.q = self.u\n",
        "        self.q = self.u\n        self.task.stamp_ns = self.task.now\n",
    )
    between = MODULES["between"].replace('"measured")', '"measured", max_age=0.05)')
    assert robot != MODULES["robot"]
    assert between != MODULES["between"]
    modules = MODULES | {"robot": robot, "between": between}
    cycles, _, _ = ran(tmp_path, "CRITICAL\n", modules)
    assert flags(cycles, STABLE).size
    assert not (cycles["flags"][-80:] & STABLE).any(), "it has gone on"
    acted = flags(cycles, STABLE)[2:]
    assert np.array_equal(acted, np.arange(acted[0], acted[-1] + 1)), "and once only"


def test_the_state_of_a_robot_that_holds_is_on(tmp_path) -> None:
    _, _, events = ran(tmp_path, "STALE hold\n")
    told = [(e["code"], e["text"]) for e in events if e["task"] == "robot"]
    assert ("STALE", "the input U of robot is stale: hold") in told
    assert ("FRESH", "the inputs of robot are fresh again") in told
    assert State.ERROR.value not in {text for _, text in told}


def test_safe_values_at_failures_are_declared_and_no_cycle_fails(tmp_path) -> None:
    """Nothing takes time there: the line is read, and changes nothing."""
    robot, log, _ = ran(tmp_path, "STALE safe\nSAFE deadline\n")
    assert flags(robot, SAFE).size
    assert all(verdict.good for verdict in verify(log))
