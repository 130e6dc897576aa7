"""Tasks are run again together: what one makes otherwise, the others read."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import made_logs
import numpy as np
import pytest
from adding_module import ADDS, SVAR
from log_of_python_tasks import RMOD, Shop, drive

from pbonet.errors import LogError, ModuleLoadError
from pbonet.log import Log, LogWriter, text
from pbonet.log.rewrite import merge
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.testing import rerun, verify

OTHER = ADDS.replace("dt / 3.0", "dt / (3.5 if self.task.name == 'a' else 3.0)")


@pytest.fixture
def record(tmp_path):
    """Return what records such a run, of some code, in a folder of its own."""

    def run(name, code=ADDS, do=drive, **more):
        folder = tmp_path / name
        folder.mkdir()
        with contextlib.closing(Shop(folder, code)) as shop:
            do(shop)
            return shop.log(**more)

    return run


def test_the_same_code_gives_the_same_together(record) -> None:
    found = rerun(record("r"))
    assert found.good, str(found)
    assert [one.cycles for one in found.tasks] == [20, 21]
    assert str(found).startswith("2 tasks together: identical")


def test_other_code_of_one_task_is_felt_by_those_that_read_it(record, tmp_path) -> None:
    path, wanted = record("r"), Log(record("other", OTHER))
    path.with_name("adds.py").write_text(OTHER)
    assert verify(path, ["b"])[0].good, "by itself, b has not changed"
    found = rerun(path, out=tmp_path / "now.mcap")
    a, b = found.tasks
    assert found.first == "a"
    assert (a.divergence.cycle, a.divergence.variable) == (1, "Y0")
    assert (b.divergence.cycle, b.divergence.variable) == (1, "Y1")
    assert "the first to differ is a" in str(found)
    assert rerun(path, ["b"]).good, "of a, the record stands"

    # What is made now is what a run of the other code has given.
    then, now = Log(path), Log(tmp_path / "now.mcap")
    for task, name in (("a", "Y0"), ("b", "Y1")):
        made = now.arrays(task)[name]
        assert np.array_equal(made, wanted.arrays(task)[name])
        assert not np.array_equal(made, then.arrays(task)[name])
    assert now.about["run"] == "r-replay"


def drive_elsewhere(shop):
    shop.table.write("X", [-8.0, 0.5])
    drive(shop)


def test_registers_of_two_machines_are_two_though_their_logs_are_one(
    record, tmp_path
) -> None:
    one = record("one", machine="boot-1")
    two = record("two", do=drive_elsewhere, machine="boot-2")
    keys = [
        (row["register"].tolist(), row["number"].tolist())
        for (life,) in (Log(one).lives("a"), Log(two).lives("a"))
        for row in [life.schema.arrays(life.commits)]
    ]
    assert keys[0] == keys[1], "the same names of commits"
    assert not np.array_equal(Log(one).arrays("a")["Y0"], Log(two).arrays("a")["Y0"])
    merge([one, two], tmp_path / "both.mcap")
    merge([tmp_path / "both.mcap"], tmp_path / "again.mcap")
    for name in ("both", "again"):
        log = Log(tmp_path / f"{name}.mcap")
        assert [life.origin.machine for life in log.lives("b")] == ["boot-1", "boot-2"]
        for verdict, cycles in zip(verify(log), (40, 42), strict=True):
            assert (verdict.good, verdict.cycles) == (True, cycles), str(verdict)
    found = rerun(tmp_path / "both.mcap", out=tmp_path / "now.mcap")
    assert found.good, str(found)
    then, now = Log(tmp_path / "both.mcap"), Log(tmp_path / "now.mcap")
    for old, new in zip(then.all_lives(), now.all_lives(), strict=True):
        assert (new.about.task, new.origin) == (old.about.task, old.origin)
        assert [new.schema.group(one) for one in new.commits] == [
            old.schema.group(one) for one in old.commits
        ]


def lose_some(shop):
    shop.cycles(3)
    shop.b.cycle(lost=2)
    shop.a.cycle()


def test_what_is_not_on_record_ends_a_task_and_not_the_others(record) -> None:
    found = rerun(record("r", do=lose_some))
    a, b = found.tasks
    assert (a.cycles, a.good) == (4, True)
    assert b.gaps == ["2 records were lost after cycle 3"]
    assert not found.good


def test_a_log_without_its_attachments_is_run_all_the_same(record) -> None:
    """The RMOD is in the channel; files are there to name lines that have changed."""
    path = record("r", attached=False)
    assert Log(path).attached == {}
    code = path.with_name("adds.py")
    code.write_text(f"{ADDS}\n")
    for one in verify(path):
        assert one.good
        assert [other.lines for other in one.changed] == [[]], "which ones is unknown"
    assert rerun(path).good
    code.unlink()
    with pytest.raises(ModuleLoadError):
        rerun(path, ["a"])
    assert "the library has no module adds" in str(rerun(path))


@pytest.fixture
def simulation(tmp_path):
    """The log of 0.2 s of a simulated job, whose files are gone; and its library."""
    library, folder = tmp_path / "library", tmp_path / "cell" / "jobs"
    library.mkdir()
    folder.mkdir(parents=True)
    (library / "adds.py").write_text(ADDS)
    (folder / "x.job").write_text("JOB x\nDESC\nSBS ../x.sbs\nTASK a\nTASK b\nEOF\n")
    (folder / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (folder / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    text = "SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n"
    (tmp_path / "cell" / "x.sbs").write_text(text)
    (tmp_path / "cell" / "x.svar").write_text(SVAR)
    place = Place(libraries=(str(library),))
    outcome = run(
        folder / "x.job", place, seconds=0.2, sim=True, runs=tmp_path, quiet=True
    )
    shutil.rmtree(tmp_path / "cell")
    return Path(outcome.log), library


def test_a_simulation_is_simulated_again_from_its_log(simulation) -> None:
    log, library = simulation
    found = rerun(log)
    assert found.good, str(found)
    assert [(one.cycles, one.recorded) for one in found.tasks] == 2 * [(20, 20)]
    assert found.seconds == 0.2
    (library / "adds.py").write_text(ADDS.replace("dt / 3.0", "dt / 3.5"))
    found = rerun(log)
    assert (found.first, found.tasks[0].cycles) == ("a", 0)
    assert "first divergence: cycle 1: Y[0] is " in str(found)
    path = library / "adds.py"
    for one in found.tasks:
        assert [change.path for change in one.changed] == [str(path)]
        assert one.changed[0].lines
    assert rerun(log, rtol=1.0).good


def test_what_a_simulation_gives_now_is_written(simulation, tmp_path) -> None:
    log, library = simulation
    (library / "adds.py").write_text(ADDS.replace("dt / 3.0", "dt / 3.5"))
    out = tmp_path / "now.mcap"
    found = rerun(log, out=out)
    assert found.first == "a"
    rows = text.diff(Log(log), Log(out))
    assert {(row["task"], *row["cycles"], row["first"]) for row in rows} == {
        ("a", 20, 20, 1),
        ("b", 20, 20, 1),
    }
    assert rerun(out).good
    with pytest.raises(LogError, match=r"now\.mcap: the log cannot be written"):
        rerun(log, out=out)


@pytest.mark.parametrize("again", [verify, rerun])
def test_a_log_without_cycles_proves_nothing(again, tmp_path) -> None:
    writer = LogWriter(tmp_path / "run.mcap", made_logs.run())
    for task in ("pid", "other"):
        writer.add_task(made_logs.about(task, made_logs.PLAIN))
    writer.close()
    with pytest.raises(LogError, match="the log has no cycle of pid, other"):
        again(tmp_path / "run.mcap")


def test_a_simulation_without_its_files_says_which_is_missing(simulation) -> None:
    log, _ = simulation
    of = Log(log)
    kept = {name: one for name, one in of.attached.items() if name != "x.svar"}
    of.attached = kept
    with pytest.raises(LogError, match="does not contain") as caught:
        rerun(of)
    assert caught.value.expected == "x.svar among its attachments"
