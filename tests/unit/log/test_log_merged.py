"""Several runs, and several subsystems of one machine, in one file."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from adding_module import ADDS
from log_of_python_tasks import Shop, drive

from pbonet.log import Log, text
from pbonet.log.rewrite import merge
from pbonet.testing import rerun, verify

EPOCH = 10**18


def drive_otherwise(shop):
    shop.table.write("X", [-8.0, 0.5])
    drive(shop)


@pytest.fixture
def record(tmp_path):
    """Return what records such a run, in a folder of its own."""

    def run(name, do=drive, code=ADDS, **more):
        folder = tmp_path / name
        folder.mkdir()
        with contextlib.closing(Shop(folder, code)) as shop:
            do(shop)
            return shop.log(machine="boot", **more)

    return run


def groups(life):
    return [life.schema.group(one) for one in life.commits]


def test_registers_of_two_runs_are_two(record, tmp_path) -> None:
    one = record("one", run="monday")
    two = record("two", drive_otherwise, run="tuesday")
    out = tmp_path / "both.mcap"
    merge([two, one], out)
    log = Log(out)
    assert [life.origin.run for life in log.lives("b")] == ["monday", "tuesday"]
    for verdict, cycles in zip(verify(log), (40, 42), strict=True):
        assert (verdict.good, verdict.cycles) == (True, cycles), str(verdict)
    assert rerun(log).good


def test_tasks_of_one_name_in_two_subsystems_are_two(record, tmp_path) -> None:
    left = record("left", subsystem="left")
    right = record("right", drive_otherwise, subsystem="right")
    merge([left, right], tmp_path / "both.mcap")
    merge([tmp_path / "both.mcap"], tmp_path / "again.mcap")
    for name in ("both", "again"):
        log = Log(tmp_path / f"{name}.mcap")
        assert log.tasks == ["left/a", "left/b", "right/a", "right/b"]
        for side, path in (("left", left), ("right", right)):
            alone = Log(path)
            for task in ("a", "b"):
                got, wanted = log.arrays(f"{side}/{task}"), alone.arrays(task)
                assert all(np.array_equal(got[k], wanted[k]) for k in wanted)
        for verdict in verify(log):
            assert verdict.good, str(verdict)
        assert {one.task for one in verify(log, ["right/b"])} == {"right/b"}
        assert rerun(log).good
        assert "right/b" in text.info_text(text.info(log))


def test_the_metadata_and_attachments_of_all_files_are_kept(record, tmp_path) -> None:
    one = record("one", run="monday", config_hash="1", host="lab1")
    two = record("two", run="tuesday", code=f"{ADDS}\n# other", config_hash="2")
    three = record("three", run="wednesday", rtpu="arm1")
    code = [str(path.with_name("adds.py")) for path in (one, two, three)]
    merge([one, two], tmp_path / "both.mcap")
    out = tmp_path / "all.mcap"
    merge([three, tmp_path / "both.mcap"], out)
    (part,) = Log(out).parts
    assert [one.about.run for one in part.sources] == ["monday", "tuesday", "wednesday"]
    assert [one.about.config_hash for one in part.sources] == ["1", "2", ""]
    assert part.about.run == "monday"
    for source, path, file in zip(part.sources, (one, two, three), code, strict=True):
        alone = Log(path).attached[file]
        assert part.attached[source.attached[file]].data == alone.data
    data = text.info(Log(out))
    assert [one["run"] for one in data["sources"]] == ["monday", "tuesday", "wednesday"]
    lines = text.info_text(data).splitlines()
    assert "made of run monday, subsystem arm, arm0 on lab1" in lines
    assert "made of run wednesday, subsystem arm, arm1 on ?" in lines


def test_attachments_of_one_name_are_told_by_whose_they_are(record, tmp_path) -> None:
    one = record("one", run="monday", files={"x.job": b"first"})
    two = record("two", run="tuesday", files={"x.job": b"second"})
    merge([one, two], tmp_path / "both.mcap")
    merge([tmp_path / "both.mcap"], tmp_path / "again.mcap")
    for name in ("both", "again"):
        log = Log(tmp_path / f"{name}.mcap")
        (part,) = log.parts
        found = [part.attached[one.attached["x.job"]].data for one in part.sources]
        assert found == [b"first", b"second"]
        (line,) = [
            line
            for line in text.info_text(text.info(log)).splitlines()
            if line.startswith("made of run tuesday")
        ]
        assert line.endswith("its x.job is x-2.job")


def test_what_a_rerun_writes_has_the_clock_of_each_file(record, tmp_path) -> None:
    one = record("one", run="monday", epoch_ns=EPOCH)
    two = record("two", drive_otherwise, run="tuesday", epoch_ns=EPOCH + 10**15)
    merge([one, two], tmp_path / "both.mcap")
    for name, path in (("of_both", tmp_path / "both.mcap"), ("of_two", two)):
        then = Log(path)
        assert rerun(then, out=tmp_path / f"{name}.mcap").good
        now = Log(tmp_path / f"{name}.mcap")
        for old, new in zip(then.all_lives(), now.all_lives(), strict=True):
            assert new.origin == old.origin
            assert groups(new) == groups(old)
            assert new.commits.times.tolist() == old.commits.times.tolist()
