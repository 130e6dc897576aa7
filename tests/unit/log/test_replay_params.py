"""Parameters of a replay: the recorded ones, and what the files have now."""

from __future__ import annotations

import pytest
from adding_module import ADDS, SVAR
from log_of_python_tasks import RMOD, Shop

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


def test_a_run_records_where_its_rmods_are(tmp_path) -> None:
    (tmp_path / "adds.py").write_text(ADDS)
    (tmp_path / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nEOF\n")
    (tmp_path / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (tmp_path / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    (tmp_path / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (tmp_path / "x.svar").write_text(SVAR)
    place = Place(libraries=(str(tmp_path),))
    job, runs = tmp_path / "x.job", tmp_path / "runs"
    log = run(job, place, seconds=0.1, sim=True, runs=runs, quiet=True).log
    (tmp_path / "a.rmod").write_text(RMOD.format(z="X", y="Y").replace("0.75", "3"))
    for verdict in (*verify(log, ["a"]), *rerun(log, ["a"]).tasks):
        assert verdict.good
        assert "a.rmod has changed: gain is 3 there, recorded" in str(verdict)
