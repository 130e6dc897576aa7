"""A table that stands on several machines, whose clocks are far apart."""

from __future__ import annotations

import time

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

    def fresh():
        now = cell.value("arm2", "Y0")
        assert now.age >= 0
        return now.cycle > far.cycle + 20 and now.age < 1.0 and not now.stale

    wait_for(fresh, "news of src, as old as they are")
    news = wait_for(
        lambda: (now := carried(cell)) and now.commits > 10 and now,
        "what was carried to be counted",
    )
    assert news.subsystem == "cell"
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


def test_a_variable_is_carried_at_its_rate(cell):
    """Written 200 times a second, carried 5 times; what is told again adds none."""
    cell.spawn("arm0", "slow", "counts", out="Z1")
    cell.on("arm0", "slow")
    wait_for(lambda: cell.value("arm2", "Z1").cycle, "news")
    commits, took = wait_for(lambda: stretch(cell), "one in which no link was lost")
    assert 3 <= commits <= 5 * took + 1


def stretch(cell):
    """Return how many commits of 600 cycles were carried, and in which time at most.

    None if they and those that were not are fewer: counts begin anew with a link.
    """
    begin = time.monotonic()
    before, first, age = settled(cell)
    after, last, _ = wait_for(
        lambda: (now := settled(cell))[1] >= first + 600 and now, "cycles"
    )
    took = time.monotonic() - begin + age
    commits, gaps = after.commits - before.commits, after.gaps - before.gaps
    return (commits, took) if commits + gaps == last - first else None


def settled(cell):
    """Return what has come to arm2's machine; cycle and age of its Z1 at that time."""

    def unchanged():
        first, news = cell.value("arm2", "Z1"), carried(cell)
        same = cell.value("arm2", "Z1").cycle == first.cycle
        return news and same and (news, first.cycle, first.age)

    return wait_for(unchanged, "two looks between which nothing comes")


def carried(cell):
    """Return what arm2's machine has got from arm0's; None if they have no link."""
    report = cell.look("arm2", m.Links(), m.LinkReport)
    found = [one for one in report.tables if one.host == "host-a"]
    return found[0] if found else None


def test_who_comes_later_is_brought_up_to_date(lab):
    """Values, constants, what an operator has set, the flag; a master gets events."""
    cell = Desk(lab, "cell", ("arm0", "arm1"))
    try:
        cell.spawn("arm0", "src", "counts", out="Y0")
        cell.spawn("arm1", "lab", "gives", out="", gives="MASS", local={"mass": 2.5})
        cell.on("arm0", "src")
        cell.write("X", [7.0, 8.0])
        cell.flag("arm1", "no hand on the wheel", up=True)
        cell.join("arm2")
        assert cell.value("arm2", "MASS").values == [2.5]
        assert cell.value("arm2", "MASS").writer == "lab@host-b"
        assert cell.value("arm2", "X").values == [7.0, 8.0]
        assert cell.value("arm2", "Y0").writer == "src@host-a"
        assert "no hand on the wheel" in cell.illegal("arm2")
        first = cell.value("arm2", "Y0").cycle
        wait_for(lambda: cell.value("arm2", "Y0").cycle > first, "news of src")
        later = lab.client("c").call("arm0", m.Events(), list[m.Event])
        assert [e.task for e in later if e.code == "STATE"], later
    finally:
        cell.close()


def test_a_link_between_tasks_at_1_khz(cell, lab, lan):
    """Each record is new, in order and as old as it says; each that is lost is counted.

    The cable between the two hosts goes silent and comes back; meanwhile the agents go
    by way of the third host.
    """
    khz = {"freq": 1000.0, "local": {"link": "cell:beat"}}
    cell.spawn("arm0", "beat", "beats", out="Y0", **khz)
    cell.spawn("arm2", "ear", "hears_beats", out="TALLY", **khz)
    cell.on("arm0", "beat")
    cell.on("arm2", "ear")
    taken(cell, 1000)
    lan.mute("a", "c")
    try:
        wait_for(lambda: tally(cell)["age"] > 0.05, "an old record")
    finally:
        lan.heal("a", "c")
    silent = tally(cell)
    wait_for(lambda: tally(cell)["lost"] > silent["lost"] + 100, "a gap")
    end = taken(cell, silent["taken"] + 500)
    assert end["wrong"] == end["restarts"] == 0
    assert end["taken"] + end["lost"] == end["last"] - end["first"] + 1
    assert end["aged"] > 0
    lab.wait_all()


def tally(cell):
    """Return what `hears_beats` has counted."""
    names = ("first", "last", "taken", "lost", "wrong", "aged", "restarts", "age")
    return dict(zip(names, cell.value("arm2", "TALLY").values, strict=True))


def taken(cell, count):
    """Wait until so many records have come."""
    return wait_for(lambda: (now := tally(cell))["taken"] >= count and now, "records")


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
