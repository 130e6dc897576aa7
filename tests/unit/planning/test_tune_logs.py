"""``pbonet tune --from-log``: rates by recorded runs, here those of simulations."""

from __future__ import annotations

import json

import numpy as np
import pytest
from chain_job import chain_job

from pbonet.config import Variable
from pbonet.errors import LogError, UnknownTaskError, VerificationError
from pbonet.log import Log
from pbonet.master.configuration import Place
from pbonet.master.planning import tune, tuning_text
from pbonet.master.planning.rates_from_logs import fit_logs

pytest.importorskip("scipy")
RATES = ((20, 20), (10, 20), (20, 10), (40, 40))
"""Hz of a and b in each run."""


@pytest.fixture
def job(tmp_path):
    job = chain_job(tmp_path)
    sensor = tmp_path / "sense.rmod"
    sensor.write_text(sensor.read_text().replace("FREQ 1000", "FREQ 200"))
    return job


@pytest.fixture
def runs(job, tmp_path, call):
    """A recorded run for each pair of rates."""
    text, found = job.read_text(), []
    for a, b in RATES:
        rates = text.replace("TASK a ", f"TASK a FREQ {a} ")
        job.write_text(rates.replace("TASK b\n", f"TASK b FREQ {b}\n"))
        folder = tmp_path / f"a{a}b{b}"
        words = ("run", job, "--sim", "--seconds", 1.2, "--runs", folder)
        status, _, err = call(*words)
        assert status == 0, err
        found.append(next(folder.glob("*/")))
    job.write_text(text)
    return found


def error_in(run, settle):
    """Return the error of a run, instant by instant."""
    log = Log(run)
    y, s = ([*zip(*log.series(name), strict=True)] for name in "YS")
    begin, end = max(y[0][0], s[0][0]) + settle, min(y[-1][0], s[-1][0])

    def value(series, at):
        return [each for seconds, each in series if seconds <= at][-1].item()

    times = np.linspace(begin, end, 2001)[:-1]
    return np.mean([abs(value(y, at) - value(s, at)) for at in times])


def test_the_errors_are_those_of_the_runs_and_the_fit_proposes(job, runs, call):
    words = [word for run in runs for word in ("--from-log", run)]
    words = ["tune", job, "--keep", "sense", "--settle", 0.2, *words]
    status, out, err = call(*words, "--json")
    assert status == 0, err
    data = json.loads(out)
    seen = data["runs"]
    assert [one["rates"] for one in seen[:4]] == [{"a": a, "b": b} for a, b in RATES]
    assert not any(one["predicted"] for one in seen[:4])
    assert seen[1]["error"] == pytest.approx(error_in(runs[1], 0.2), rel=0.02)
    assert data["present"] == seen[0], "the job has these rates"
    proposed = [one for one in seen if one["predicted"]]
    assert proposed
    for one in proposed:
        slopes = data["fit"]["slopes"]
        predicted = sum(slopes[n] / hz for n, hz in one["rates"].items())
        assert one["error"] == pytest.approx(predicted + data["fit"]["constant"])
        assert all(10 <= hz <= 40 for hz in one["rates"].values()), "as was run"
    allowed = [one["error"] for one in seen if one["allowed"]]
    assert data["best"]["error"] == min(allowed) < data["present"]["error"]
    status, out, _ = call(*words)
    assert status == 0
    assert ("it was not run" in out) is data["best"]["predicted"]


def test_what_the_runs_do_not_tell_is_refused(job, runs):
    how = {"keep": ["sense"], "settle": 0.2}
    with pytest.raises(VerificationError, match=r"2 runs do not tell .* a and b"):
        tune(job, Place(), logs=[runs[0], runs[3]], **how)
    with pytest.raises(VerificationError, match="1 runs do not tell"):
        tune(job, Place(), logs=runs[:1], **how)
    with pytest.raises(VerificationError, match=r"not longer than the 9 s of --settle"):
        tune(job, Place(), logs=runs, keep=["sense"], settle=9.0)
    with pytest.raises(LogError):
        tune(job, Place(), logs=[job.parent / "nowhere"], **how)


def test_a_run_that_gives_no_error_is_named_and_does_not_count(job, runs, monkeypatch):
    """One has two lives of a task, at two rates; another job has a larger variable."""
    lives = Log.lives

    def two_lives(self, task):
        found = lives(self, task)
        if self.path == runs[3]:
            found += lives(Log(runs[0]), task)
        return found

    monkeypatch.setattr(Log, "lives", two_lives)
    how = {"keep": ["sense"], "settle": 0.2}
    found, _ = tune(job, Place(), logs=runs, **how)
    (fault,) = [one for one in found.runs if one.fault]
    assert (fault.why, fault.allowed) == (runs[3].name, False)
    assert fault.fault == "a had no single rate in it"
    assert fault.rates["a"] == 0
    assert f"{fault.why}: {fault.fault}" in tuning_text.text(found)
    tuning_text.write_svg(found, job.parent / "tune.svg")
    larger = [Variable(name=name, type="double", nelem=2) for name in "YS"]
    with pytest.raises(VerificationError, match="Y has 1 elements in it, and 2 in"):
        fit_logs(runs, None, "ab", cost="rms(Y - S)", table=larger, settle=0.2)


def test_a_task_with_one_rate_in_all_runs_keeps_it(job, runs):
    found, warnings = tune(job, Place(), logs=runs[:2], keep=["sense"], settle=0.2)
    assert {*found.present.rates} == {"a"}
    assert any("all runs have b at 20 Hz" in one for one in warnings)
    with pytest.raises(UnknownTaskError, match="no periodic task nobody"):
        tune(job, Place(), logs=runs, tasks=["nobody"])


def test_options_of_virtual_time_do_not_go_with_logs(job, call):
    status, _, err = call("tune", job, "--from-log", "x.mcap", "--factor", 2)
    assert status == 2
    assert "--factor and --seconds are for runs in virtual time" in err
