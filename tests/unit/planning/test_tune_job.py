"""``pbonet tune``: errors of a job in virtual time, and the rates that are proposed."""

from __future__ import annotations

import contextlib
import json
import re
import resource
import sys
from types import SimpleNamespace

import pytest
from chain_job import chain_job

from pbonet.analysis.schedule import dataflow
from pbonet.config import read_job
from pbonet.errors import ConfigFileError, PbonetError, VerificationError
from pbonet.master.configuration import Place, check_file
from pbonet.master.console import oneshot
from pbonet.master.planning import apply_rates, tune, tune_job
from pbonet.master.planning.parallel_runs import parallel_runs
from pbonet.master.planning.virtual_run import Wish, measured

pytest.importorskip("scipy")
MS = 1_000_000


@pytest.mark.parametrize(("a_first", "periods"), [(True, (20, 100)), (False, (70,))])
def test_figure_6_5_by_a_job(tmp_path, a_first, periods):
    """The job's error is that of the schedule alone, whose curves the page has.

    The ideal output of the job is a staircase of a millisecond.
    """
    job = chain_job(tmp_path, a_first=a_first)
    for period in periods:
        wish = Wish(
            job=str(job),
            rates={"b": 1000 / period},
            cost="mean(Y - S)",
            seconds=1.9,
            settle=0.7,
        )
        seen = measured(wish)
        (wanted,) = dataflow.errors([period * MS], a_first=a_first, seconds=1.9)
        assert not seen.missing
        assert seen.error == pytest.approx(wanted, rel=0.04)


@pytest.mark.usefixtures("here")
def test_rates_are_proposed_drawn_and_written(tmp_path, call):
    pytest.importorskip("matplotlib")
    job, plot = chain_job(tmp_path), tmp_path / "tune.svg"
    sensor = tmp_path / "sense.rmod"
    sensor.write_text(sensor.read_text().replace("FREQ 1000", "FREQ 250"))
    words = ["tune", job, "--keep", "sense", "--factor", 0.7, "--factor", 2]
    words += [
        "--seconds",
        0.63,
        "--settle",
        0.2,
        "--limit",
        0.3,
        "--svg",
        plot,
        "--write",
    ]
    status, out, err = call(*words, "--json")
    assert status == 0, err
    data = json.loads(out)
    runs = data["runs"]
    assert {one["why"] for one in runs} == {"present", "grid", "fit", "harmonic"}
    assert runs[0]["loads"]["arm"] == pytest.approx(0.2)
    assert not any(one["allowed"] for one in runs if one["loads"]["arm"] > 0.301)
    allowed = [one["error"] for one in runs if one["allowed"]]
    assert data["best"]["error"] == min(allowed) < data["present"]["error"]
    assert data["best"]["loads"]["arm"] <= 0.301
    assert plot.read_text().startswith("<?xml")
    rates = {one.rmod: one.freq for one in read_job(job).tasks if one.freq}
    assert rates == data["rates"] != {}
    assert "# samples" in job.read_text()
    assert check_file(job).legal


def test_a_copy_has_the_rates_and_the_job_stays(tmp_path):
    job = chain_job(tmp_path)
    before = job.read_text()
    taken = tmp_path / "chain_tuned.job"
    taken.write_text("a user's own")
    editor = apply_rates.draft(job, {"a": 28.5, "b": 14.0})
    (copy,) = apply_rates.save_copy(editor)
    assert copy.name == "chain_tuned_2.job"
    assert (job.read_text(), taken.read_text()) == (before, "a user's own")
    assert "# samples" in copy.read_text()
    record = read_job(copy)
    assert record.name == "chain_tuned_2"
    assert {one.rmod: one.freq for one in record.tasks if one.freq} == {
        "a": 28.5,
        "b": 14.0,
    }
    assert check_file(copy).legal


def test_a_copy_that_does_not_fit_leaves_no_part_of_it(tmp_path):
    job = chain_job(tmp_path)
    editor = apply_rates.draft(job, {"a": 28.5})
    before = {path.name for path in tmp_path.iterdir()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, hard))
    try:
        with pytest.raises(ConfigFileError, match="cannot be written"):
            apply_rates.save_copy(editor)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {path.name for path in tmp_path.iterdir()} == before


def test_what_an_interrupt_ends_leaves_nothing(tmp_path, monkeypatch):
    """The runs are ended amid their work; what they left in their folder is removed."""
    answers = tmp_path / "answers"
    answers.write_text(
        '#!/bin/sh\ntouch "$PBONET_SHM_DIR/left"\nread one\necho "{}"\nexec sleep 60\n'
    )
    answers.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(answers))

    def stop(_done, _every):
        raise KeyboardInterrupt

    wish = Wish(job="", rates={}, cost="mean(Y - S)", seconds=0.2, settle=0.0)
    with parallel_runs(stop) as runs:
        folder, processes = runs._folder, runs._processes
        with pytest.raises(KeyboardInterrupt):
            runs.results([wish] * 9)
        assert (folder / "left").exists()
    assert not folder.exists()
    assert processes
    assert all(one.poll() is not None for one in processes)


@pytest.fixture
def here(monkeypatch):
    """Make the runs in this process; the test of agents has real ones."""

    class Here:
        def results(self, wishes):
            return [measured(wish) for wish in wishes]

    monkeypatch.setattr(
        tune_job, "parallel_runs", lambda _told: contextlib.nullcontext(Here())
    )


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("when", ["True", "dt < 0.03"])
def test_runs_in_which_a_task_fails_do_not_count(tmp_path, call, when):
    job = chain_job(tmp_path)
    module = tmp_path / "hands_on.py"
    raises = f"if {when}: raise ValueError('too fast')"
    text = module.read_text().replace("self.v = self.u", raises)
    module.write_text(text + "        self.v = self.u\n")
    words = ("--keep", "sense", "--task", "a", "--factor", 2)
    words += ("--seconds", 0.3, "--settle", 0.1)
    status, out, err = call("tune", job, *words)
    if when == "True":
        assert status == 1
        assert "no run gives an error" in err
        assert "a.cycle: ValueError: too fast" in err
        return
    assert status == 0, err
    assert re.search(r"40 +- .* no +grid: .* a.cycle: ValueError: too fast", out)
    assert "the present rates stay" in out


@pytest.mark.usefixtures("here")
def test_an_error_that_is_no_number_is_not_the_least(tmp_path, call):
    words = ("--keep", "sense", "--cost", "mean(1 / (X - X))", "--seconds", 0.2)
    status, _, err = call("tune", chain_job(tmp_path), *words, "--factor", 2)
    assert (status, "no run gives an error" in err) == (1, True)


def test_what_cannot_be_tuned_is_refused(tmp_path, call):
    job = chain_job(tmp_path)
    text = job.read_text()
    with pytest.raises(PbonetError, match="did you mean sense"):
        tune(job, Place(), keep=["sens"])
    with pytest.raises(VerificationError, match="no task is left"):
        tune(job, Place(), keep=["sense", "a", "b"])
    with pytest.raises(PbonetError, match="Z, which the table does not have"):
        tune(job, Place(), cost="mean(Y - Z)")
    with pytest.raises(PbonetError, match=r"^--cost:1:1: COST names no variable"):
        tune(job, Place(), cost="rms(1)")
    with pytest.raises(PbonetError, match=r"COST is malformed .* rms\(X\)"):
        tune(job, Place(), cost="sum(Y)")
    job.write_text(text.replace("COST mean(Y - S)\n", ""))
    with pytest.raises(PbonetError, match="does not say which error is to be small"):
        tune(job, Place())
    job.write_text(text.replace("(Y - S)", "(Y - Q)"))
    found = check_file(job)
    assert "names Q, which the table does not have" in found.errors[0]["what"]
    assert found.errors[0]["where"].endswith("chain.job:4:15")
    assert call("tune", job, "--write", "--apply")[0] == 2
    assert call("tune", job, "--dry-run")[0] == 2


def test_slower_tasks_are_set_first_and_a_refusal_is_taken_back(monkeypatch):
    before = SimpleNamespace(rates=dict.fromkeys(["fast", "slow", "last"], 100.0))
    rates = {"fast": 200.0, "slow": 10.0, "last": 300.0}
    found = SimpleNamespace(rates=rates, present=before)
    asked = []

    def run(_job, command, args, _place):
        asked.append((command, args["task"], args["hz"]))
        if args["hz"] == refused or (args["task"], args["hz"]) == (lost, 100.0):
            raise PbonetError("no")

    monkeypatch.setattr(oneshot, "run", run)
    refused = lost = None
    done = apply_rates.set_rates("x.job", found, Place(), lambda: ["x.job"])
    assert done == ([("slow", 10.0), ("fast", 200.0), ("last", 300.0)], ["x.job"])
    asked.clear()
    refused = 300.0
    with pytest.raises(PbonetError, match="no") as caught:
        apply_rates.set_rates("x.job", found, Place(), list)
    assert caught.value.__notes__ == ["the tasks have their former rates again"]
    assert asked[3:] == [("freq", "fast", 100.0), ("freq", "slow", 100.0)]

    def unwritable():
        raise ConfigFileError("the file cannot be written")

    refused, lost = None, "fast"
    asked.clear()
    with pytest.raises(ConfigFileError) as caught:
        apply_rates.set_rates("x.job", found, Place(), unwritable)
    assert asked[3:] == [("freq", n, 100.0) for n in ("last", "fast", "slow")]
    assert caught.value.__notes__ == [
        "fast could not be set back: 'pbonet freq' shows the rates"
    ]
