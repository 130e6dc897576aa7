"""Standbys in virtual time: engaged at the instant of an error, as on an RTPU."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from virtual_job import VirtualJob

from pbonet import State
from pbonet.errors import (
    ConditionError,
    LogError,
    NoAnswerError,
    ReconfigError,
    Severity,
    StateError,
    UnknownTaskError,
)
from pbonet.master.configuration.environment import Place
from pbonet.master.console.prompt import Prompt
from pbonet.master.console.run_job import run
from pbonet.master.sim.virtual_loop import BEGIN_NS
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.master.tools.schedule_job import simulate
from pbonet.testing import rerun, verify
from pbonet.xm.net import messages as m

MS = 1_000_000
SOURCE = '''
"""Counts, until it fails."""

from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, param


class Ends(Params):
    """When."""

    cycles: A[int, param("none", "that go well; 0 for all")] = 0
    refuses: A[bool, param("none", "whether `on` raises")] = False


class Source(PortBasedObject[Ends]):
    """Count."""

    y: A[float, OutVar("Y", "1", "none", "count")]

    def on(self) -> None:
        self._left = self.params.cycles
        if self.params.refuses:
            raise ValueError("not today")

    def cycle(self, dt: float) -> None:
        self._left -= 1
        if self._left == 0:
            self.task.fail("enough")
        self.y += 1.0
'''
SINK = '''
"""Remembers."""

from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject


class Sink(PortBasedObject):
    """z = y; -1 while something is wrong."""

    x: A[float, InVar("Y", "1", "none", "count")]
    z: A[float, OutVar("Z", "1", "none", "count, later")]

    def cycle(self, dt: float) -> None:
        self.z = self.x

    def stable(self, dt: float) -> None:
        self.z = -1.0
'''
RMOD = """\
MODULE   {module}
DESC     test
INCONST  none
OUTCONST none
INVAR    {invar}
OUTVAR   {outvar}
TASKTYPE periodic
FREQ     {freq}
{more}EOF
"""
JOB = "JOB j\nDESC test\nSBS s.sbs\nTASK first FALLBACK second\nTASK sink\nEOF\n"


def source(folder: Path, name: str, freq: float = 100, **local: object) -> None:
    lines = "".join(f"{key} {value}\n" for key, value in local.items())
    more = f"LOCAL\n{lines}" if lines else ""
    text = RMOD.format(module="source", invar="none", outvar="Y", freq=freq, more=more)
    (folder / f"{name}.rmod").write_text(text)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    variable = "NAME {}\nTYPE double\nDESC v\nUNITS none\nNELEM 1\n\n"
    text = "".join(map(variable.format, "YZ")) + "EOF\n"
    (tmp_path / "s.svar").write_text(text)
    (tmp_path / "s.sbs").write_text("SUBSYSTEM s\nSVARFILE s.svar\nRTPU arm0\nEOF\n")
    (tmp_path / "j.job").write_text(JOB)
    (tmp_path / "source.py").write_text(dedent(SOURCE))
    (tmp_path / "sink.py").write_text(dedent(SINK))
    sink = RMOD.format(
        module="sink", invar="Y", outvar="Z", freq=50, more="CRITICAL yes\n"
    )
    (tmp_path / "sink.rmod").write_text(sink)
    source(tmp_path, "first", CYCLES=7)
    source(tmp_path, "second")
    return tmp_path


def started(folder: Path) -> VirtualJob:
    simulation = VirtualJob(folder / "j.job", [folder])
    simulation.start()
    return simulation


def releases(simulation: VirtualJob, task: str) -> list[float]:
    """Return the releases of a task, ms after the beginning."""
    arrays = simulation.recording.arrays(task)
    return [round((one - BEGIN_NS) / MS, 3) for one in arrays["release_ns"].tolist()]


def test_at_the_instant_of_the_error_it_runs_in_the_lost_cycle_s_place(folder):
    simulation = started(folder)
    assert simulation.states()["second"] is State.OFF
    assert [one.stands_by for one in simulation.rtpu_status()[0].tasks] == [
        False,
        True,
        False,
    ]
    simulation.wait(0.1)
    last = releases(simulation, "first")[-1]
    assert releases(simulation, "second")[:3] == [last + 10, last + 20, last + 30]
    assert simulation.states() == {
        "first": State.ERROR,
        "second": State.ON,
        "sink": State.ON,
    }
    counts = simulation.recording.arrays("second")["Y"].ravel()
    assert counts[0] == simulation.recording.arrays("first")["Y"].ravel()[-1] + 1
    assert np.all(np.diff(counts) == 1)
    assert not simulation.table.illegal
    assert [event.split(" ", 2)[2] for event in simulation.events][-1:] == [
        "second: first is in ERROR: its fallback second was released by the "
        "dispatcher; state ON, time 1 of 3"
    ]


def test_a_slower_one_begins_at_once_and_goes_on_with_its_own_grid(folder):
    source(folder, "second", freq=40)  # 25 ms; the error comes 10 ms into a period
    simulation = started(folder)
    simulation.wait(0.2)
    at = releases(simulation, "first")[-1] + 10
    first, second, *_ = releases(simulation, "second")
    assert first == at
    assert second % 25 == 0
    assert 12.5 < second - first <= 37.5


def test_one_that_fails_too_leaves_the_flag_up_and_others_their_turns(folder):
    source(folder, "second", REFUSES="yes")
    simulation = started(folder)
    simulation.wait(0.2)
    assert simulation.states()["second"] is State.ERROR
    assert simulation.table.illegal
    assert simulation.display(["Z"])[0].values == [-1.0]
    assert len(releases(simulation, "sink")) >= 9
    assert "state ERROR" in simulation.events[-1]
    assert "no task writes its variables: second.on: " in simulation.events[-1]
    simulation.stop()


def test_nothing_flaps(folder):
    simulation = started(folder)
    for time in (1, 2, 3):
        simulation.wait(0.1)
        assert f"time {time} of 3" in simulation.events[-1]
        simulation.control("first", "clear")
        assert simulation.states()["second"] is State.ON, "nobody takes its place back"
        simulation.reconfig([("second", "off"), ("first", "on")])
    assert simulation.events[-1].endswith("second will not stand by again")
    simulation.wait(0.1)
    assert simulation.states()["first"] is State.ERROR
    assert simulation.states()["second"] is State.OFF


def test_what_is_ended_in_order_is_not_replaced(folder):
    simulation = started(folder)
    simulation.wait(0.02)
    simulation.control("first", "off")
    simulation.wait(0.1)
    assert simulation.states()["second"] is State.OFF
    simulation.control("first", "on")
    simulation.control("second", "kill")
    simulation.wait(0.1)
    assert simulation.states()["first"] is State.ERROR


def test_a_program_in_virtual_time_sees_the_same(folder):
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        assert arm.status("second").stands_by
        assert arm.status("second").fallback_of == "first"
        arm.wait(0.1)
        assert {one.task: one.state for one in arm.status_all()} == {
            "first": "ERROR",
            "second": "ON",
            "sink": "ON",
        }
        (told,) = [event for event in arm.events() if event.code == "FALLBACK"]
        assert (told.task, told.severity) == ("second", Severity.WARNING)
        assert arm.display(["Y"])[0].writer == "second"
        same = m.Standby(task="second", original="second")
        with pytest.raises(StateError, match="cannot be its own fallback"):
            arm.clients.call("arm0", same, m.TaskStatus)
        arm.control("first", "clear")
        arm.swap("second", "first")
        assert arm.status("second").stands_by
        arm.stop()
        assert arm.status_all() == []


def test_a_swap_to_the_fallback_is_a_swap_like_others(folder):
    source(folder, "first")
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        items = [("first", "off"), ("second", "on")]
        assert arm.swap("first", "second", dry_run=True).items == items
        assert arm.status("second").stands_by
        arm.swap("first", "second")
        states = {one.task: one.state for one in arm.status_all()}
        assert states == {"first": "OFF", "second": "ON", "sink": "ON"}
        assert arm.display(["Y"])[0].writer == "second"
        back = arm.switch()  # to the job that says who stands by for whom
        assert back.items == [("second", "off"), ("first", "on")]
        assert (back.kills, back.stays) == ([], ["sink"])
        assert arm.status("second").stands_by


def test_one_that_writes_less_lets_the_flag_down_all_the_same(folder):
    """Nobody reads what it does not write: the job was judged with it in the place."""
    module = (folder / "source.py").read_text()
    more = '    more: A[float, OutVar("W", "1", "none", "more")]\n'
    (folder / "wide.py").write_text(module.replace("    y: A[", f"{more}    y: A["))
    table = (folder / "s.svar").read_text()
    wide = table[: table.index("NAME Z")].replace("NAME Y", "NAME W")
    (folder / "s.svar").write_text(wide + table)
    text = (folder / "first.rmod").read_text()
    text = text.replace("source", "wide").replace("OUTVAR   Y", "OUTVAR   W Y")
    (folder / "first.rmod").write_text(text)
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        arm.wait(0.1)
        states = {one.task: one.state for one in arm.status_all()}
        assert states == {"first": "ERROR", "second": "ON", "sink": "ON"}
        assert arm.rtpu_status()[0].illegal == []
        assert arm.display(["Z"])[0].values[0] > 0.0, "cycle, and not stable"
        arm.off("second")
        assert arm.rtpu_status()[0].illegal == [
            "equation 2: no task writes Y for sink (master)"
        ]


def test_a_switch_kills_nobody_for_a_task_that_fails_at_once(folder):
    source(folder, "first")
    source(folder, "bad", CYCLES=1)
    other = JOB.replace("JOB j", "JOB k").replace("first FALLBACK second", "bad")
    (folder / "k.job").write_text(other)
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        with pytest.raises(ReconfigError, match="bad, which has come on") as e:
            arm.switch("k")
        assert (e.value.done, e.value.rest) == (2, (("first", "kill"),))
        assert arm.switch("j").states == {"first": "ON", "bad": "NOT-CREATED"}


def test_a_switch_does_not_wait_for_who_is_slower_than_that(folder):
    source(folder, "first")
    source(folder, "slow", freq=0.1)
    other = JOB.replace("JOB j", "JOB k").replace("first FALLBACK second", "slow")
    (folder / "k.job").write_text(other)
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        begun = arm.clock.now()
        assert arm.switch("k").states == {"first": "NOT-CREATED", "slow": "ON"}
        assert arm.clock.now() - begun < 1.0


def test_a_switch_that_is_not_made_leaves_no_fallback(folder):
    source(folder, "first")
    pair = JOB.replace("JOB j", "JOB k").replace(" FALLBACK second", "")
    (folder / "k.job").write_text(pair)
    (folder / "late.job").write_text(
        JOB.replace("JOB j", "JOB late").replace(
            "TASK first", "PRE Z > 1e9\nTASK first"
        )
    )
    with Subsystem(folder / "k.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        arm.spawn("second")
        second = arm.model.find("second")
        arm.switch("j", dry_run=True)
        assert not second.fallback_of
        with pytest.raises(ConditionError):
            arm.switch("late")
        assert not second.fallback_of
        arm.switch("j")
        assert second.fallback_of == "first"


@pytest.fixture
def jobs(folder):
    """Jobs with the same tasks: nobody stands by, the third one does, or it works."""
    source(folder, "first")
    source(folder, "third")
    for name, lines in {
        "k": "TASK first",
        "third": "TASK first FALLBACK third",
        "other": "TASK second",
        "kill": "TASK third",
    }.items():
        job = JOB.replace("JOB j", f"JOB {name}")
        job = job.replace("TASK first FALLBACK second", lines)
        (folder / f"{name}.job").write_text(job)
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        yield arm


def fallbacks(arm):
    """Return of each fallback whose it is, and whether it stands by."""
    return {
        status.task: (status.fallback_of, bool(status.stands_by))
        for status in arm.status_all()
        if status.fallback_of or status.stands_by
    }


def test_a_switch_ends_what_its_job_does_not_name(jobs):
    assert fallbacks(jobs) == {"second": ("first", True)}
    jobs.switch("k", dry_run=True)
    assert fallbacks(jobs) == {"second": ("first", True)}
    jobs.switch("k")
    assert fallbacks(jobs) == {}
    assert jobs.status("second").state == "OFF"
    jobs.switch("j")
    assert fallbacks(jobs) == {"second": ("first", True)}


def test_another_fallback_comes_in_the_place_of_the_first(jobs):
    jobs.switch("third")
    assert fallbacks(jobs) == {"third": ("first", True)}


def test_a_fallback_that_becomes_a_task_of_its_own_is_none_any_more(jobs):
    jobs.switch("other")
    assert jobs.status("second").state == "ON"
    jobs.spawn("first")
    assert fallbacks(jobs) == {}
    jobs.swap("second", "first")
    assert fallbacks(jobs) == {}


def test_one_that_was_engaged_and_is_killed_does_not_come_back_as_a_fallback(jobs):
    jobs.swap("first", "second")
    jobs.switch("kill")
    assert {one.task for one in jobs.status_all()} == {"third", "first", "sink"}
    jobs.spawn("second")
    jobs.swap("third", "first")
    assert fallbacks(jobs) == {}


def test_a_start_takes_no_fallback_from_a_task_by_saying_nothing(jobs):
    """Its job comes beside the one that named it, unlike that of a switch."""
    jobs.control("sink", "off")
    jobs.start("k")
    assert fallbacks(jobs) == {"second": ("first", True)}


@pytest.mark.parametrize(
    ("job", "left"), [("third", {"third": ("first", True)}), ("other", {})]
)
def test_a_start_ends_a_fallback_that_its_job_replaces_or_has_as_a_task(
    jobs, job, left
):
    for task in ("first", "sink"):
        jobs.control(task, "off")
    jobs.start(job)
    assert fallbacks(jobs) == left


def test_what_could_not_be_ended_is_told_and_done_the_next_time(jobs, monkeypatch):
    told = []
    jobs.warned = told.append
    call = jobs.clients.call

    def mostly(rtpu, request, kind, **more):
        if isinstance(request, m.Standby):
            raise NoAnswerError("no answer")
        return call(rtpu, request, kind, **more)

    monkeypatch.setattr(jobs.clients, "call", mostly)
    jobs.switch("k")
    assert "second is still the fallback of first: no answer" in told[-1]
    monkeypatch.undo()
    assert fallbacks(jobs) == {"second": ("first", True)}
    jobs.switch("k")
    assert fallbacks(jobs) == {}


def test_virtual_time_has_no_prompt(folder):
    with (
        Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm,
        pytest.raises(StateError, match="a prompt needs a subsystem in real time"),
    ):
        Prompt(arm)


def test_one_that_never_ran_is_no_divergence(folder, tmp_path):
    source(folder, "first")
    place = Place(libraries=(str(folder),))
    outcome = run(
        folder / "j.job", place, seconds=0.2, sim=True, runs=tmp_path, quiet=True
    )
    found = rerun(outcome.log, rtol=1e-9)
    assert found.good, str(found)
    assert [(one.task, one.recorded) for one in found.tasks if not one.recorded] == [
        ("second", 0)
    ]
    for again in (verify, rerun):
        assert again(outcome.log)
        with pytest.raises(LogError, match="the log has no cycle of second"):
            again(outcome.log, ["second"])


def test_nobody_stands_by_for_a_task_of_another_rtpu(folder):
    both = "SUBSYSTEM s\nSVARFILE s.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
    (folder / "s.sbs").write_text(both)
    alias = "SVARALIAS Y=W\nINCONST"
    variable = "NAME W\nTYPE double\nDESC v\nUNITS none\nNELEM 1\n\nEOF\n"
    table = (folder / "s.svar").read_text().replace("EOF\n", variable)
    (folder / "s.svar").write_text(table)
    source(folder, "stranger", CYCLES=3)
    text = (folder / "stranger.rmod").read_text().replace("INCONST", alias, 1)
    (folder / "stranger.rmod").write_text(text)
    with Subsystem(folder / "j.job", libraries=[str(folder)], virtual=True) as arm:
        arm.start()
        assert arm.status("second").stands_by
        arm.control("second", "kill")
        arm.spawn("stranger", "arm1")
        arm.spawn("second", "arm1")
        assert not arm.status("second").stands_by
        elsewhere = m.Standby(task="second", original="first")
        with pytest.raises(UnknownTaskError) as caught:
            arm.clients.call("arm1", elsewhere, m.TaskStatus)
        told = "arm1: subsystem s has no task first here"
        assert str(caught.value).startswith(told)
        arm.control("stranger", "on")
        arm.wait(0.05)
        assert arm.status("stranger").state == "ERROR"
        assert arm.status("second").state == "OFF"


def test_a_schedule_says_that_it_has_none(folder):
    _, told = simulate(folder / "j.job", 0.05, [folder], assume=0.1, code=True)
    assert "the fallback second of first is not simulated" in told
