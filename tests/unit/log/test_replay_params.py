"""Parameters of a replay: the recorded ones, and what the files have now."""

from __future__ import annotations

import json

import numpy as np
import pytest
from adding_module import ADDS, SVAR
from log_of_python_tasks import RMOD, Shop

from pbonet.errors import ParameterError, UnknownTaskError
from pbonet.log import Log, text
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.testing import ChangedParam, rerun, verify


@pytest.fixture
def path(tmp_path):
    """Return a log of two tasks, whose RMODs are beside their module."""
    shop = Shop(tmp_path)
    try:
        shop.cycles(4)
        for task in (shop.a, shop.b):
            file = tmp_path / f"{task.task}.rmod"
            file.write_text(RMOD.format(z="X", y="Y0"))
            task.about.rmod_name = str(file)
        return shop.log()
    finally:
        shop.close()


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("gain 0.75", "GAIN 2.5", "gain is 2.5 there, recorded and used 0.75"),
        ("gain 0.75\n", "", "gain is not set there, recorded and used 0.75"),
        ("TASKTYPE", "TASKTIPE", " cannot be read, its recorded text is used: "),
    ],
)
def test_a_changed_parameter_is_named(path, tmp_path, before, after, text) -> None:
    file = tmp_path / "a.rmod"
    file.write_text(file.read_text().replace(before, after))
    for verdicts in (verify(path), rerun(path).tasks):
        a, b = verdicts
        assert a.good
        assert str(file) in str(a)
        assert text in str(a)
        assert not b.params


def test_the_same_number_in_other_words_is_no_change(path, tmp_path) -> None:
    file = tmp_path / "a.rmod"
    file.write_text(file.read_text().replace("gain 0.75", "GAIN 7.5e-1"))
    assert not verify(path, ["a"])[0].params


def test_a_folder_that_is_named_goes_before_the_recorded_place(path, tmp_path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    file = other / "a.rmod"
    file.write_text((tmp_path / "a.rmod").read_text().replace("0.75", "3"))
    (verdict,) = verify(path, ["a"], libraries=[other])
    assert verdict.params == [
        ChangedParam(name="gain", path=str(file), recorded="0.75", now="3")
    ]
    file.unlink()
    (tmp_path / "a.rmod").unlink()
    assert not verify(path, ["a"], libraries=[other])[0].params


@pytest.fixture
def simulated(tmp_path):
    """Return the log of a simulation of two tasks, and the RMOD of one."""
    (tmp_path / "adds.py").write_text(ADDS)
    (tmp_path / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nEOF\n")
    (tmp_path / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (tmp_path / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    (tmp_path / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (tmp_path / "x.svar").write_text(SVAR)
    place = Place(libraries=(str(tmp_path),))
    job, runs = tmp_path / "x.job", tmp_path / "runs"
    log = run(job, place, seconds=0.1, sim=True, runs=runs, quiet=True).log
    return log, tmp_path / "a.rmod"


def test_a_run_records_where_its_rmods_are(simulated) -> None:
    log, file = simulated
    file.write_text(file.read_text().replace("0.75", "3"))
    for verdict in (*verify(log, ["a"]), *rerun(log, ["a"]).tasks):
        assert verdict.good
        assert f"{file} has changed: gain is 3 there, recorded" in str(verdict)


@pytest.mark.parametrize("value", ["1.5", 1.5, np.float64(1.5), [1.5]], ids=repr)
def test_another_value_is_tried_on_the_recorded_inputs(path, tmp_path, value) -> None:
    out = tmp_path / "out.mcap"
    found = rerun(path, out=out, params={"a": {"GAIN": value}})
    (verdict,) = found.tasks
    assert verdict.tried == ["gain 1.5, recorded 0.75"]
    assert found.good
    then, now = (Log(one).arrays("a")["Y0"] for one in (path, out))
    assert np.allclose(now[0] - then[0], 0.75 * np.array([1.0, 2.0]) * 0.01)
    (row,) = found.differences
    assert (row["variable"], row["first"]) == ("Y0", 1)
    assert row["largest"] == np.abs(now - then).max()
    then, now = (Log(one).arrays("b")["Y1"] for one in (path, out))
    assert np.array_equal(then, now), "its record is used"
    assert Log(out).task_about("a").tried == verdict.tried
    said = "a was replayed with gain 1.5, recorded 0.75"
    assert said in text.info_text(text.info(Log(out))).splitlines()


def test_tasks_that_are_named_read_the_new_outputs(path, tmp_path) -> None:
    out = tmp_path / "out.mcap"
    found = rerun(path, ["b"], out=out, params={"a": {"gain": 1.5}})
    assert [one.task for one in found.tasks] == ["b", "a"]
    assert found.good
    assert [row["first"] for row in found.differences] == [1, 1]


def test_a_recorded_set_of_the_same_parameter_is_ignored(tmp_path) -> None:
    shop = Shop(tmp_path)
    try:
        shop.cycles(2)
        shop.a.set("2.5")
        shop.cycles(2)
        path = shop.log()
    finally:
        shop.close()
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    (row,) = rerun(path, out=one, params={"a": {"gain": 0.75}}).differences
    assert row["first"] == 3
    (row,) = rerun(path, out=other, params={"a": {"gain": 2.5}}).differences
    assert row["first"] == 1


def test_a_wrong_parameter_is_refused(path) -> None:
    with pytest.raises(
        ParameterError, match=r"a\.gian: .*no parameter gian.*mean gain"
    ):
        rerun(path, params={"a": {"gian": 2}})
    with pytest.raises(ParameterError, match=r"a\.gain: a value of parameter gain is"):
        rerun(path, params={"a": {"gain": "much"}})
    with pytest.raises(UnknownTaskError, match="no task c"):
        rerun(path, params={"c": {"gain": 2}})


def test_code_that_fails_with_it_has_failed(path, tmp_path) -> None:
    code = ADDS.replace("+= self", "+= 1 / max(0.0, 1.0 - self.params.gain) + self")
    (tmp_path / "adds.py").write_text(code)
    (verdict,) = rerun(path, params={"a": {"gain": 2}}).tasks
    assert verdict.differs
    assert not verdict.good
    assert "ZeroDivisionError" in str(verdict)


def test_a_simulation_is_tried_on_its_recorded_inputs(simulated) -> None:
    log, _ = simulated
    found = rerun(log, params={"a": {"gain": 3}})
    assert found.good, str(found)
    assert [row["variable"] for row in found.differences] == ["Y"]
    assert found.differences[0]["first"] == 1


def test_the_verb_tries_shows_and_draws(call, path, tmp_path) -> None:
    place = ["replay", path, "--set", "a", "gain", "1.5"]
    picture = tmp_path / "a.svg"
    status, out, _ = call(*place, "--plot", picture)
    assert status == 0
    assert "tried: gain 1.5, recorded 0.75" in out
    assert out.splitlines()[-1].split()[:4] == ["a", "Y0", "4/4", "1"]
    assert "<svg" in picture.read_text()
    status, out, _ = call(*place, "--json")
    assert json.loads(out)["differences"][0]["largest"] > 0
    file = tmp_path / "soft.rmod"
    file.write_text((tmp_path / "a.rmod").read_text().replace("0.75", "0.5"))
    status, out, _ = call("replay", path, "a", "--params-from", file)
    assert status == 0
    assert "tried: gain 0.5, recorded 0.75" in out
    file = file.rename(tmp_path / "a.rmod")
    out = call("replay", path, "--params-from", file)[1]
    assert "tried: gain 0.5, recorded 0.75" in out
    assert "has changed" not in out, "it is used"
    assert "gain 1.5, recorded" in call(*place, "--params-from", file)[1]


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (("--params-from", "soft.rmod"), "the log has no task soft"),
        (("--set", "a", "gain", "2", "--verify"), "--verify excludes --set"),
        (("--set", "a", "gain", "2", "--play", "a"), "--play takes only"),
        (("--set", "a", "gain"), "--set needs 3 words: --set TASK PARAM VALUE"),
        (("--set=a", "gain", "2"), "--set needs 3 words"),
        (("--plot", "x.svg"), "no output differs"),
        (("--set", "a", "gain", "0.75", "--plot", "x.svg"), "no output differs"),
    ],
)
def test_the_verb_refuses(call, path, monkeypatch, words, wanted) -> None:
    tmp_path = path.parent
    monkeypatch.chdir(tmp_path)
    (tmp_path / "soft.rmod").write_text((tmp_path / "a.rmod").read_text())
    status, _, err = call("replay", path, *words)
    assert status in {1, 2}
    assert wanted in err
    assert not (tmp_path / "x.svg").exists()
