"""What a job says of recording holds for the log of its simulation."""

from __future__ import annotations

from pathlib import Path

import pytest
from adding_module import ADDS, SVAR
from log_of_python_tasks import RMOD

from pbonet.log import Log
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.testing import rerun


def simulated(folder, *lines, record=None):
    """Return the log of a simulated job with these RECORD lines; None: it has none."""
    told = "".join(f"RECORD {line}\n" for line in lines)
    (folder / "adds.py").write_text(ADDS)
    text = f"JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\n{told}EOF\n"
    (folder / "x.job").write_text(text)
    (folder / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (folder / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    (folder / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (folder / "x.svar").write_text(SVAR)
    outcome = run(
        folder / "x.job",
        Place(libraries=(str(folder),)),
        seconds=0.2,
        sim=True,
        runs=folder / "runs",
        quiet=True,
        record=record,
    )
    return Log(Path(outcome.log)) if outcome.log else None


def test_a_task_that_is_not_recorded(tmp_path) -> None:
    log = simulated(tmp_path, "off b")
    assert log.tasks == ["a"]
    assert rerun(log).good


def test_one_task_of_all_that_are_off(tmp_path) -> None:
    assert simulated(tmp_path, "off", "outputs b").tasks == ["b"]


def test_a_variable_that_is_not_recorded(tmp_path) -> None:
    log = simulated(tmp_path, "off Y")
    assert (log.variables("a"), log.variables("b")) == ([], ["X"])
    found = rerun(log)
    assert found.good, "what is not recorded is not compared"
    assert [one.cycles for one in found.tasks] == [20, 20]


@pytest.mark.parametrize(("lines", "record"), [(["off"], None), ([], "off")])
def test_nothing_is_recorded(tmp_path, lines, record) -> None:
    assert simulated(tmp_path, *lines, record=record) is None
    assert not (tmp_path / "runs").exists()


def test_the_command_line_goes_before_tasks(tmp_path) -> None:
    assert simulated(tmp_path, "off b", record="outputs").tasks == ["a", "b"]
