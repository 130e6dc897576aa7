"""A table that stands on several machines, whose clocks are far apart."""

from __future__ import annotations

import pytest
from hostfleet import Desk
from watching import wait_for

from pbonet.errors import SvarOwnerError
from pbonet.xm import messages as m


@pytest.fixture(scope="module")
def clocks():
    return {"b": 5000.0, "c": 90000.0}


@pytest.fixture(scope="module", autouse=True)
def machines(lab):
    lab.triangle()


@pytest.fixture
def cell(lab):
    """A subsystem on all three; arm0 keeps the table."""
    desk = Desk(lab, "cell")
    yield desk
    desk.close()


def test_a_group_arrives_whole_with_its_age(cell):
    cell.spawn("arm0", "src", "counts", out="Y0")
    cell.on("arm0", "src")
    far = cell.value("arm2", "Y0")
    assert far.writer == "src@host-a"
    later = wait_for(
        lambda: (now := cell.value("arm2", "Y0")).cycle > far.cycle + 20 and now,
        "news of src",
    )
    assert 0 <= later.age < 1.0
    assert not later.stale
    report = cell.ask("arm2", m.Links(), m.LinkReport)
    (news,) = [one for one in report.tables if one.host == "host-a"]
    assert news.subsystem == "cell"
    assert news.commits > 10
    assert news.refused == 0


def test_a_reader_elsewhere_takes_part(cell):
    """A task on c reads what one on a writes, and one on b reads that."""
    cell.spawn("arm0", "src", "counts", out="Y0")
    local = {"level": 1.0}
    cell.spawn("arm2", "sink", "holds", out="Y1", invar="Y0", local=local)
    cell.on("arm0", "src")
    cell.on("arm2", "sink")
    wait_for(lambda: cell.value("arm1", "Y1").cycle > 20, "sink's values on b")


def test_what_the_operator_sets_is_everywhere(cell):
    cell.write("X", [7.0, 8.0])
    for rtpu in ("arm0", "arm1", "arm2"):
        assert cell.value(rtpu, "X").values == [7.0, 8.0]


def test_a_swap_between_machines(cell):
    """When `off` is answered the others know, and `on` elsewhere is not refused."""
    cell.spawn("arm0", "one", "counts", out="Y0")
    cell.spawn("arm2", "two", "counts", out="Y0")
    for _ in range(5):
        cell.on("arm0", "one")
        with pytest.raises(SvarOwnerError, match="owner one@host-a"):
            cell.on("arm2", "two")
        cell.off("arm0", "one")
        cell.on("arm2", "two")
        assert cell.value("arm1", "Y0").writer == "two@host-c"
        cell.off("arm2", "two")


def test_the_flag_reaches_all(cell):
    cell.flag("arm1", "no hand on the wheel", up=True)
    for rtpu in ("arm0", "arm1", "arm2"):
        wait_for(
            lambda r=rtpu: "no hand on the wheel" in cell.illegal(r), f"flag at {rtpu}"
        )
    cell.flag("arm1", "no hand on the wheel", up=False)
    for rtpu in ("arm0", "arm1", "arm2"):
        wait_for(lambda r=rtpu: not cell.illegal(r), f"no flag at {rtpu}")
