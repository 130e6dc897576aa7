"""A table that stands on several machines, whose clocks are far apart."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import pytest
from hostfleet import Desk
from long_limits import LIMIT
from watching import wait_for

from pbonet.errors import PbonetError, SvarOwnerError
from pbonet.node.ring._ring import Ring
from pbonet.xm.net import messages as m

AGE_ERROR = 0.3
"""Seconds by which an age may be wrong where a round trip takes long."""


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


def test_the_age_two_machines_down_the_chain_is_that_of_the_source(cell):
    """One on b goes on to copy what one on a wrote last; c sees how old that is."""
    cell.spawn("arm0", "src", "counts", out="Z0")
    cell.spawn("arm1", "relay", "holds", out="Y1", invar="Z0", local={"level": 1.0})
    cell.on("arm0", "src")
    cell.on("arm1", "relay")

    def fresh():
        now = cell.value("arm2", "Y1")
        return now.cycle and now.age < AGE_ERROR

    wait_for(fresh, "values as they come")
    cell.off("arm0", "src")
    wait_for(lambda: cell.value("arm0", "Z0").age > 4 * AGE_ERROR, "old values")
    first = cell.value("arm2", "Y1")
    wait_for(lambda: cell.value("arm2", "Y1").cycle > first.cycle, "another copy")
    before = cell.value("arm0", "Z0").age
    copy = cell.value("arm2", "Y1")
    after = cell.value("arm0", "Z0").age
    assert before - AGE_ERROR < copy.age < after + AGE_ERROR


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


def stand_by(cell, there, new, *olds, far):
    """Have a task stand by; return how its predecessors call it."""
    successors = m.Successors(after={new: list(olds)}, far=far, timeout=LIMIT)
    return cell.look(there, successors, dict[str, list[m.Call]])


def turn_off(cell, here, old, output, calls):
    """Turn a task off that hands a variable over."""
    off = m.Reconfig(items=[(old, "off")], handover={old: [output]}, calls=calls)
    assert cell.look(here, off, m.Reconfigured).done == 1


def leave(cell, here, old, there, new):
    """Have a task stand by on another machine, and the one before it leave."""
    turn_off(cell, here, old, "Y0", stand_by(cell, there, new, old, far=[old]))


def come(cell, there, new):
    """Send the `on` of a task that stands by, or came on already."""
    answer = cell.ask(there, m.Reconfig(items=[(new, "on")]), m.Reconfigured)
    if answer.error is not None:
        raise PbonetError.from_wire(answer.error)
    assert answer.states == {new: "ON"}


def is_on(cell, rtpu, task):
    return cell.status(rtpu, task).state == "ON"


def start_counting(cell):
    """Have `one` count on arm0; `two` counts on from what it finds on arm2."""
    cell.spawn("arm0", "one", "counts_on", out="Y0")
    cell.spawn("arm2", "two", "counts_on", out="Y0")
    cell.on("arm0", "one")


def last_count(cell, rtpu, task):
    """Return what a task that is OFF has written last."""
    ring = Ring.attach(cell.status(rtpu, task).ring)
    try:
        *_, last = (one for one in ring.drain() if not one.kind)
    finally:
        ring.close()
    return float(np.frombuffer(last.data)[0])


def test_an_heir_on_another_machine_is_called(cell, lab, monkeypatch):
    """It begins with what the old one wrote last, before anybody sends its `on`.

    A machine that stands still amid that may make no call; then the `on` does it.
    """
    start_counting(cell)
    by_itself, turn = 0, [("arm0", "one", "a"), ("arm2", "two", "c")]
    for _ in range(4):
        (here, old, host), (there, new, _) = turn
        first = cell.value(there, "Y0").values[0]
        wait_for(lambda r=there, n=first: cell.value(r, "Y0").values[0] > n, "news")
        leave(cell, here, old, there, new)
        with contextlib.suppress(AssertionError):
            wait_for(lambda r=there, n=new: is_on(cell, r, n), "a call", 3.0)
            by_itself += 1
        come(cell, there, new)
        monkeypatch.setenv("PBONET_SHM_DIR", str(lab.shm_dirs[host]))
        assert cell.value(there, "Y0").values[1] == last_count(cell, here, old)
        turn.reverse()
    assert by_itself


@pytest.mark.parametrize("where", ["arm1", "arm2"], ids=["both far", "one near"])
def test_a_successor_waits_for_tasks_of_two_machines(cell, where):
    """The one of its own machine calls itself, the agent for the other one."""
    cell.spawn("arm0", "one", "counts", out="Y0")
    cell.spawn(where, "other", "counts", out="Y1")
    cell.spawn("arm2", "two", "counts", out="Y0")
    cell.on("arm0", "one")
    cell.on(where, "other")
    wait_for(lambda: cell.value("arm2", "Y0").writer == "one@host-a", "news")
    far = ["one", "other"] if where == "arm1" else ["one"]
    calls = stand_by(cell, "arm2", "two", "one", "other", far=far)
    turn_off(cell, where, "other", "Y1", calls)
    turn_off(cell, "arm0", "one", "Y0", calls)
    come(cell, "arm2", "two")
    assert cell.value("arm1", "Y0").writer == "two@host-c"
    assert cell.value("arm2", "Y0").writer == "two"


def test_a_cable_is_cut_amid_a_swap(cell, lab, lan):
    """What was done stands, and the flag is up; the rest is sent again."""
    start_counting(cell)
    lan.cut("a", "c")
    lan.cut("b", "c")
    try:
        leave(cell, "arm0", "one", "arm2", "two")
        wait_for(lambda: "no task took over Y0" in cell.illegal("arm0"), "the flag")
    finally:
        lan.heal("a", "c")
        lan.heal("b", "c")
    lab.wait_all()
    last = cell.value("arm0", "Y0").values[0]

    def again():
        with contextlib.suppress(SvarOwnerError):  # its end is not known there yet
            come(cell, "arm2", "two")
            return True

    wait_for(again, "the heir")
    assert cell.value("arm2", "Y0").values[1] == last
    for rtpu in ("arm0", "arm1", "arm2"):
        wait_for(lambda r=rtpu: not cell.illegal(r), f"no flag at {rtpu}")
        wait_for(lambda r=rtpu: cell.value(r, "Y0").values[0] > last, f"news at {rtpu}")


def test_the_flag_reaches_all(cell):
    cell.flag("arm1", "no hand on the wheel", up=True)
    for rtpu in ("arm0", "arm1", "arm2"):
        wait_for(
            lambda r=rtpu: "no hand on the wheel" in cell.illegal(r), f"flag at {rtpu}"
        )
    cell.flag("arm1", "no hand on the wheel", up=False)
    for rtpu in ("arm0", "arm1", "arm2"):
        wait_for(lambda r=rtpu: not cell.illegal(r), f"no flag at {rtpu}")
