"""Agents, machines, cables and masters that are lost; both sides act, and all heals."""

from __future__ import annotations

import os
import signal

import pytest
from hostfleet import Desk
from hostkit import Lab
from nodekit import alive, fork_server_of, processes_of
from watching import wait_for

from pbonet.testing.lan import Lan, missing, netem
from pbonet.xm import messages as m

SLOW = missing() or netem()
"""Why a cable cannot be made slow here."""


@pytest.fixture
def lab(lan: Lan):
    """Agents for one test: it loses some of them."""
    lan.heal_all()
    made = Lab(lan)
    try:
        yield made
    finally:
        lan.heal_all()
        made.close()


@pytest.fixture
def cell(lab, tmp_path):
    """arm0 on a writes Z0, which ages; arm1 on b reads it, and is CRITICAL."""
    lab.start("arm0", "a", grace=30.0, runs=str(tmp_path))
    lab.start("arm1", "b", connect=[lab.endpoint("a", "b")], grace=30.0)
    lab.wait_all()
    desk = Desk(lab, "cell", ("arm0", "arm1"), host="b")
    desk.spawn("arm0", "src", "counts", out="Z0")
    wanted = {"invar": "Z0", "local": {"level": 1.0}, "critical": True}
    desk.spawn("arm1", "sink", "holds", out="Y1", **wanted)
    desk.on("arm0", "src")
    desk.on("arm1", "sink")
    wait_for(lambda: not desk.illegal("arm1"), "a legal configuration")
    wait_steady(desk)
    yield desk
    desk.close()


def wait_steady(desk):
    """Wait until news of src reach the other machine, and sink runs its cycle."""
    first = desk.value("arm1", "Z0").cycle

    def steady():
        now = desk.value("arm1", "Z0")
        level = desk.value("arm1", "Y1").values[0]
        return now.cycle != first and not now.stale and level != -1.0

    wait_for(steady, "news of src", 20.0)
    assert desk.value("arm1", "Z0").writer == "src@host-a"


def wait_stable(desk):
    """Wait until the reader's side has acted: stale input, flag, `stable`."""
    wait_for(lambda: desk.illegal("arm1"), "the flag")
    wait_for(lambda: desk.value("arm1", "Y1").values[0] == -1.0, "stable()")
    wait_for(lambda: desk.value("arm1", "Z0").stale, "a stale input")


@pytest.mark.parametrize("how", [Lan.cut, Lan.mute])
def test_a_cable_is_pulled_and_plugged_in_again(cell, lan, how):
    """Or it carries nothing any more, and neither end is told."""
    how(lan, "a", "b")
    wait_stable(cell)
    lost = "host host-a is out of sight; nobody writes Z0"
    wait_for(lambda: lost in cell.illegal("arm1"), "the agent's own cause")
    lan.heal("a", "b")
    wait_for(lambda: not cell.illegal("arm1"), "healing", 20.0)
    wait_steady(cell)
    assert cell.status("arm0", "src").state == "ON"


def test_a_split_in_which_both_sides_write(cell, lan, lab):
    """Neither is believed when they meet; the master turns one off, and all is well."""
    lan.cut("a", "b")
    wait_for(lambda: "out of sight" in cell.illegal("arm1"), "the flag")
    cell.spawn("arm1", "two", "counts", out="Z0")
    cell.on("arm1", "two")
    wait_for(lambda: not cell.illegal("arm1"), "a writer on this side", 20.0)
    lan.heal("a", "b")
    fight = "Z0 is written on two machines"
    wait_for(lambda: fight in cell.illegal("arm1"), "the fight on b", 20.0)
    lab.wait_reached("arm0", "b")
    wait_for(lambda: fight in cell.illegal("arm0"), "the fight on a", 20.0)
    assert cell.value("arm0", "Z0").writer == "src"
    assert cell.value("arm1", "Z0").writer == "two"
    cell.off("arm1", "two")
    wait_for(lambda: not cell.illegal("arm1"), "healing on b", 20.0)
    wait_for(lambda: not cell.illegal("arm0"), "healing on a", 20.0)
    wait_steady(cell)


@pytest.mark.skipif(bool(SLOW), reason=SLOW or "it can be")
def test_a_slow_cable_is_no_loss(cell, lan):
    """News come late and are as old as they are; nobody is out of sight."""
    lan.slow("a", "b", "40ms")
    try:
        wait_for(lambda: cell.value("arm1", "Z0").age > 0.04, "late news")
        wait_steady(cell)
        assert not cell.illegal("arm1")
    finally:
        lan.slow("a", "b", "")


def test_the_agent_of_the_writer_is_killed(cell, lab):
    rtpu = lab.info("arm0", "b").rtpu_pid
    lab.kill("arm0")
    wait_stable(cell)
    assert alive(rtpu)  # control goes on without its agent
    lab.start("arm0", "a", grace=30.0)
    wait_for(lambda: not cell.illegal("arm1"), "healing", 20.0)
    wait_steady(cell)
    assert lab.info("arm0", "b").rtpu_pid == rtpu


def test_the_agent_of_the_reader_is_killed(cell, lab):
    """Its RTPU process sees that nobody brings the variable, and says so at once."""
    lab.kill("arm1")
    lab.start("arm1", "b", connect=[lab.endpoint("a", "b")], grace=30.0)
    lab.wait_all()
    wait_for(lambda: not cell.illegal("arm1"), "healing", 20.0)
    wait_steady(cell)
    assert lab_events(cell, "arm1", "AGENT_GONE")


def lab_events(desk, rtpu, code):
    found = desk.ask(rtpu, m.Events(), list[m.Event])
    return [event.text for event in found if event.code == code]


def test_the_rtpu_process_of_the_writer_is_killed(cell, lab):
    """Its tasks turn themselves off and end; nothing of them is left."""
    info = lab.info("arm0", "b")
    task = cell.status("arm0", "src").tid
    os.kill(info.rtpu_pid, signal.SIGKILL)
    wait_stable(cell)
    wait_for(lambda: not alive(task), "the end of src")


def test_processes_of_the_writer_are_killed_in_turn(cell, lab):
    """Its recorder, the task itself, its fork server: both sides act, and all heals."""
    rtpu = lab.info("arm0", "b").rtpu_pid
    cell.ask("arm0", m.Record(run="lost"), m.Recorded)
    (recorder,) = lab.processes("a", "pbonet.node.recorder")
    os.kill(recorder, signal.SIGKILL)
    wait_for(lambda: lab_events(cell, "arm0", "RECORDER_DIED"), "news of its end")
    wait_for(lambda: lab.processes("a", "pbonet.node.recorder"), "another recorder")
    wait_steady(cell)
    assert not cell.illegal("arm1")
    cell.ask("arm0", m.Record(mode="off"), m.Recorded)
    os.kill(cell.status("arm0", "src").tid, signal.SIGKILL)
    wait_stable(cell)
    bring_back(cell)
    task = cell.status("arm0", "src").tid
    os.kill(fork_server_of(rtpu), signal.SIGKILL)
    wait_stable(cell)
    bring_back(cell)
    assert not alive(task)
    assert lab_events(cell, "arm0", "FORK_SERVER_DIED")
    assert lab.info("arm0", "b").rtpu_pid == rtpu


def bring_back(cell):
    """Spawn src once more, and wait until all is well."""
    wait_for(lambda: cell.status("arm0", "src").state == "NOT-CREATED", "its end")
    cell.spawn("arm0", "src", "counts", out="Z0")
    cell.on("arm0", "src")
    wait_for(lambda: not cell.illegal("arm1"), "healing", 20.0)
    wait_steady(cell)


def test_another_agent_of_the_machine_carries_on(lab):
    """Two agents on one machine: the one that carries the table is killed."""
    lab.start("arm1", "b")
    to_b = [lab.endpoint("b", "a")]
    for name in ("arm0", "arm2"):
        lab.start(name, "a", connect=to_b, listen=(), grace=30.0)
    lab.wait_all()
    cell = Desk(lab, "cell", ("arm0", "arm1", "arm2"), host="b")
    cell.spawn("arm0", "src", "counts", out="Z0")
    cell.on("arm0", "src")
    wait_for(lambda: carried(cell, "arm0"), "the first agent to carry it")
    assert not carried(cell, "arm2")
    lab.kill("arm0")
    wait_for(lambda: carried(cell, "arm2"), "the second agent to carry it")
    wait_for(lambda: not cell.illegal("arm1"), "healing", 20.0)
    before = cell.value("arm1", "Z0").cycle
    wait_for(lambda: cell.value("arm1", "Z0").cycle > before, "news of src")
    assert not cell.value("arm1", "Z0").stale
    lab.start("arm0", "a", connect=to_b, listen=(), grace=30.0)
    lab.wait_reached("arm0", "b")
    assert not carried(cell, "arm0")
    cell.close()


def carried(cell, rtpu):
    """Return what an RTPU's agent has carried from other machines."""
    return cell.ask(rtpu, m.Links(), m.LinkReport).tables


def test_a_master_that_vanishes_changes_nothing(cell, lab):
    cell.token.undeclare()
    lab.forget_session("b")
    before = cell.status("arm1", "sink").cycle
    wait_for(lambda: cell.status("arm1", "sink").cycle > before + 20, "cycles of sink")
    assert not cell.illegal("arm1")


def test_an_agent_that_stays_away_leaves_everything_off(lan):
    """The grace ends, `off` runs, and no process is left on its machine."""
    lab = Lab(lan)
    try:
        lab.start("arm0", "a", grace=0.3)
        desk = Desk(lab, "cell", ("arm0",))
        diary = lab.run_dirs["a"].parent / f"{lab.domain}.diary"
        desk.spawn("arm0", "src", "counts", out="Y0", local={"diary": diary})
        desk.on("arm0", "src")
        lab.kill("arm0")
        folder = str(lab.run_dirs["a"])
        wait_for(lambda: not processes_of("PBONET_RUN_DIR", folder), "the end", 20.0)
        assert "off" in diary.read_text()
        diary.unlink()
    finally:
        lab.close()
