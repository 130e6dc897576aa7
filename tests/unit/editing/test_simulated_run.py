"""A job that is edited runs in virtual time, and the user's files stay as they are."""

import math

import pytest
from edited_jobs import content, puma

from pbonet.errors import ConfigError
from pbonet.master.editing import JobEditor

__all__ = ["puma"]

pytestmark = pytest.mark.slow  # each starts a process


def test_the_edited_state_runs_and_its_values_come_back(puma):
    before = content(puma.parent)
    editor = JobEditor(puma)
    editor.add_task("constant", name="at", params={"VALUE": "1 2 3 4 5 6"})
    editor.connect("at", "Y", "GOAL")
    editor.apply(next(o for o in editor.offers() if o.kind == "add-variable"))
    run = editor.simulate(1.0, ["Q_MEZ", "GOAL", "NOTHING"])
    assert run.ok, run
    assert content(puma.parent) == before
    assert run.problems == [
        text for text in run.problems if "no task of the run wrote NOTHING" in text
    ]
    assert len(run.problems) == 1
    assert run.series["GOAL"]["v"][-1] == [1, 2, 3, 4, 5, 6]
    times = run.series["Q_MEZ"]["t"]
    assert len(times) == len(run.series["Q_MEZ"]["v"]) == 500
    assert times == sorted(times)
    assert {task["task"]: task["missed"] for task in run.tasks}["at"] == 0


def test_an_illegal_job_says_why_in_the_names_of_the_users_files(puma):
    editor = JobEditor(puma)
    editor.set_parameter("qrdiff", "TAU", "0.1")
    editor.remove_task("jttrace")
    run = editor.simulate(1.0)
    assert not run.ok
    (problem,) = run.problems
    assert "no task that is ON writes Q_REF" in problem
    assert "pbonet-edit-" not in problem + run.output


def test_a_run_that_takes_too_long_is_ended(puma):
    run = JobEditor(puma).simulate(3600.0, limit=0.1)
    assert not run.ok
    assert run.problems == ["it took longer than 0.1 s and was ended"]


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.inf, math.nan])
def test_a_time_that_is_none_is_refused(puma, seconds):
    with pytest.raises(ConfigError, match="the time to simulate is not above 0"):
        JobEditor(puma).simulate(seconds)


def test_a_job_in_a_folder_of_its_own(puma):
    folder = puma.parent / "jobs"
    folder.mkdir()
    job = folder / "teleop.job"
    job.write_text(puma.read_text().replace("puma.sbs", "../puma.sbs"))
    editor = JobEditor(job)
    editor.set_parameter("qrdiff", "TAU", "0.1")
    assert editor.changes()[0].file == str(folder / "qrdiff.rmod")
    run = editor.simulate(0.2, ["Q^_REF"])
    assert run.ok, run
    assert len(run.series["Q^_REF"]["t"]) == 20


def test_a_condition_that_does_not_hold_can_be_left_out(puma):
    editor = JobEditor(puma)
    editor.set_job(pre=["Q_MEZ[0] > 1 [rad]"])
    run = editor.simulate(0.1)
    assert "does not hold" in run.problems[0]
    assert editor.simulate(0.1, conditions=False).ok
    assert editor.state()["unsaved"] == [str(puma)]
