"""``pbonet allocate --apply``: tasks of a running subsystem get other RTPUs."""

from __future__ import annotations

import json

import pytest
from edited_jobs import content
from nodekit import MISBEHAVING, rmod, svar

pytest.importorskip("scipy")
SBS = "SUBSYSTEM cell\nSVARFILE cell.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
JOB = (
    "JOB work\nDESC two tasks\nSBS cell.sbs\nTASK first arm0 FIXED\nTASK second arm1\n"
)


@pytest.fixture
def job(nodes, tmp_path):
    """A job of two tasks on two agents, of which one reads the other's output."""
    folder = tmp_path / "cell"
    folder.mkdir()
    (folder / "cell.svar").write_text(svar(2))
    (folder / "cell.sbs").write_text(SBS)
    reads = {"out": "Y1", "invar": "Y0", "local": {"LEVEL": 1}}
    for name, more in (("first", {}), ("second", reads)):
        module = "holds" if more else "counts"
        text = rmod(module, freq=100.0, **more).replace(
            "FREQ 100", "FREQ 100\nMAXC 1e-3"
        )
        (folder / f"{name}.rmod").write_text(text)
    (folder / "work.job").write_text(f"{JOB}EOF\n")
    nodes.agent("arm0")
    nodes.agent("arm1")
    return folder / "work.job"


def test_a_task_takes_over_on_another_rtpu(job, nodes, call):
    where = ("--domain", nodes.domain, "--library", MISBEHAVING)

    def states():
        _, out, _ = call("status", job, *where, "--json")
        fields = {one["task"]: one["fields"] for one in json.loads(out)["tasks"]}
        return {task: (one["rtpu"], one["state"]) for task, one in fields.items()}

    status, _, err = call("start", job, *where)
    assert status == 0, err
    before = content(job.parent)
    status, out, err = call("allocate", job, *where, "--apply", "--dry-run")
    assert status == 0, err
    assert "TASK second_2 arm0" in " ".join(out.split())
    assert "spawn second_2" in out
    assert content(job.parent) == before
    assert states() == {"first": ("arm0", "ON"), "second": ("arm1", "ON")}
    status, out, err = call("allocate", job, *where, "--apply")
    assert status == 0, err
    assert states() == {"first": ("arm0", "ON"), "second_2": ("arm0", "ON")}
    assert "TASK second_2 arm0" in " ".join(job.read_text().split())
    assert (job.parent / "second_2.rmod").exists()
    assert call("stop", "cell", "--domain", nodes.domain)[0] == 0


def test_a_rate_is_set_where_it_runs(job, nodes, call):
    where = ("--domain", nodes.domain, "--library", MISBEHAVING)
    status, _, err = call("start", job, *where)
    assert status == 0, err
    words = ("--task", "first", "--factor", 0.5, "--seconds", 1)
    cost = ("--cost", "mean(Y0[0])")  # it counts its cycles
    before = job.read_text()
    status, out, err = call("tune", job, *where, *words, *cost, "--apply", "--json")
    assert status == 0, out + err
    assert json.loads(out)["set"] == {"first": 50.0}
    assert json.loads(out)["files"] == [str(job.with_name("work_tuned.job"))]
    _, out, _ = call("freq", job, "first", *where, "--json")
    assert "50.0" in out
    assert job.read_text() == before
    copy = job.with_name("work_tuned.job").read_text()
    assert copy.startswith("JOB work_tuned\n")
    assert "FREQ 50" in copy
    assert call("stop", "cell", "--domain", nodes.domain)[0] == 0
