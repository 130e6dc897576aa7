"""Exchanges at the dispatcher: what tasks and readers see of a swap."""

from __future__ import annotations

import statistics

import pytest
from nodekit import rmod, svar
from watching import wait_for

from pbonet.errors import ReconfigError
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.node.ring._ring import Ring
from pbonet.svar import Table
from pbonet.xm.net import messages as m

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nEOF\n"
RATE = 50.0
PERIOD = 1e9 / RATE


@pytest.fixture
def arm(nodes, tmp_path):
    """Five tasks on one RTPU: a and b write Y0, c and d Y1, and `other` Y2."""
    nodes.agent("arm0")
    (tmp_path / "t.sbs").write_text(SBS)
    (tmp_path / "t.svar").write_text(svar())
    outputs = {"a": "Y0", "b": "Y0", "c": "Y1", "d": "Y1", "other": "Y2"}
    for name, out in outputs.items():
        text = rmod("counts", out, RATE, local={"DIARY": tmp_path / f"{name}.txt"})
        (tmp_path / f"{name}.rmod").write_text(text)
    subsystem = Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _text: None,
        record="off",  # the rings are read here
    ).open()
    for name in outputs:
        subsystem.spawn(name, "arm0")
    for name in ("a", "c", "other"):
        subsystem.control(name, "on")
    yield subsystem
    subsystem.finish()


@pytest.fixture
def rings(arm):
    """The rings of all tasks."""
    opened = {one.task: Ring.attach(one.ring) for one in arm.status_all()}
    yield opened
    for ring in opened.values():
        ring.close()


def test_the_new_one_is_released_on_the_grid_behind_the_old_one(arm, rings):
    gaps, latest = [], {}

    def cycles(task):
        """Return what has come since the last time; what came last is kept."""
        found = [record for record in rings[task].drain() if not record.kind]
        if found:
            latest[task] = found[-1]
        return found

    old, new = "a", "b"
    for _ in range(10):
        wait_for(lambda old=old: cycles(old), f"a cycle of {old}")
        arm.swap(old, new)
        begins = wait_for(lambda new=new: cycles(new), f"cycles of {new}")[0]
        cycles(old)
        gap = (begins.release_ns - latest[old].release_ns) / PERIOD
        assert gap == round(gap) >= 1
        gaps.append(gap)
        old, new = new, old
    assert statistics.median(gaps) == 1.0  # the machine may be busy now and then


def test_somebody_owns_the_variable_at_every_instant(arm, nodes):
    with Table.attach(f"{nodes.domain}.t") as table:
        before = table.generation
        arm.swap("a", "b")
        assert table.info("Y0").owner == "b"
        assert table.generation == before + 1  # one event, not a loss and a gain
        arm.swap("b", "a")
        assert table.generation == before + 2


def test_pairs_side_by_side_change_places_in_one_list(arm):
    done = arm.swap(["a", "c"], ["b", "d"])
    assert len(done.items) == 4
    assert done.states == {"a": "OFF", "b": "ON", "c": "OFF", "d": "ON"}
    assert {value.writer for value in arm.display(["Y0", "Y1"])} == {"b", "d"}


def test_the_old_one_is_told_that_somebody_takes_over(arm, tmp_path):
    arm.swap("a", "b")
    assert (tmp_path / "a.txt").read_text().splitlines()[-1].endswith("off True")
    assert (tmp_path / "b.txt").read_text().splitlines()[-1].endswith("on")


def test_of_several_pairs_one_fails_and_the_others_are_done(arm, nodes, tmp_path):
    (tmp_path / "bad.rmod").write_text(rmod("raises_in_on", "Y0", RATE))
    arm.spawn("bad", "arm0")
    with pytest.raises(ReconfigError, match="item 4 of 4, on bad") as caught:
        arm.swap(["a", "c"], ["bad", "d"])
    assert caught.value.rest == (("bad", "on"),)
    states = {status.task: status.state for status in arm.status_all()}
    assert (states["a"], states["bad"]) == ("OFF", "ERROR")
    assert (states["c"], states["d"]) == ("OFF", "ON")
    with Table.attach(f"{nodes.domain}.t") as table:
        assert table.info("Y0").owner is None  # and not a, which ceded it
    assert arm.reconfig([("a", "on")]) == {"a": "ON"}


def test_tasks_that_share_no_variable_are_not_exchanged(arm, nodes):
    items = [("a", "off"), ("b", "kill"), ("c", "off"), ("c", "on")]
    answer = arm.clients.call("arm0", m.Reconfig(items=items), m.Reconfigured)
    assert answer.done == 4
    with Table.attach(f"{nodes.domain}.t") as table:
        assert table.info("Y0").owner is None
        assert table.info("Y1").owner == "c"
