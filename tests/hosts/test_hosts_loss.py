"""Agents, machines, cables and masters that are lost; both sides act, and all heals.

On either machine a CRITICAL task reads what one on the other writes:

    arm0 on a: src writes Z0, back reads Z2      arm1 on b: sink reads Z0, writes Z2

The agents stay from test to test; those that a test has ended are started anew.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from functools import partial

import pytest
from hostfleet import Desk
from nodekit import alive, fork_server_of
from watching import wait_for

from pbonet.errors import ClaimError
from pbonet.testing.lan import Lan
from pbonet.xm.net import messages as m

GRACE = 30.0
MAXAGE = 0.2
"""Of Z0, in seconds."""
STALL = 0.1
"""Seconds for which a machine may stand still between copy-in and cycle."""
RTPUS = ("arm0", "arm1")
ROUNDS = 20
WHERE = {"src": "src@host-a", "two": "two@host-b"}
INPUTS = {"arm0": ("back", "Z2", "Y2"), "arm1": ("sink", "Z0", "Z2")}
"""By RTPU its CRITICAL task, the variable that it reads, and the one that it writes."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return str(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def pair(lab, lan, runs):
    """arm0 on a and arm1 on b, which dials it."""
    lan.heal_all()
    lab.tend("arm0", "a", grace=GRACE, runs=runs)
    lab.tend("arm1", "b", connect=[lab.endpoint("a", "b")], grace=GRACE)
    lab.wait_all()
    yield lab
    lan.heal_all()
    lab.wait_no_orphans()


@pytest.fixture
def cell(pair):
    """Both tasks, and the one that writes what sink reads."""
    desk = Desk(pair, "cell", RTPUS, host="b")
    try:
        desk.spawn("arm0", "src", "counts", out="Z0")
        for rtpu in RTPUS:
            spawn_critical(desk, rtpu)
        desk.on("arm0", "src")
        for rtpu in RTPUS:
            desk.on(rtpu, INPUTS[rtpu][0])
        wait_healed(desk)
        yield desk
    finally:
        pair.lan.heal_all()
        try:
            pair.wait_all()
        finally:  # else no test after this one gets the subsystem
            desk.close()


def spawn_critical(desk, rtpu):
    task, read, written = INPUTS[rtpu]
    wanted = {"invar": read, "local": {"level": 1.0}, "critical": True}
    desk.spawn(rtpu, task, "holds", out=written, **wanted)


def wait_steady(desk, rtpu="arm1"):
    """Wait until news reach a machine, and its task runs its cycle."""
    _, read, written = INPUTS[rtpu]
    first = desk.value(rtpu, read).cycle

    def steady():
        now = desk.value(rtpu, read)
        level = desk.value(rtpu, written).values[0]
        news = now.cycle != first and not now.stale and level != -1.0
        return news and now.writer == writer

    writer = {"Z0": "src@host-a", "Z2": "sink@host-b"}[read]
    wait_for(steady, f"news of {read}")


def wait_stable(desk, rtpu):
    """Wait until a side has acted: stale input, flag, `stable`."""
    _, read, written = INPUTS[rtpu]
    wait_for(lambda: desk.illegal(rtpu), f"the flag at {rtpu}")
    wait_for(lambda: desk.value(rtpu, written).values[0] == -1.0, "stable()")
    wait_for(lambda: desk.value(rtpu, read).stale, "a stale input")


def wait_healed(desk):
    """Wait until all is well on both sides, and no process is left over."""
    for rtpu in RTPUS:
        wait_for(lambda r=rtpu: not desk.illegal(r), f"healing of {rtpu}")
        wait_steady(desk, rtpu)
    desk.lab.wait_no_orphans()


def test_no_cycle_acts_on_old_values_after_short_cuts(pair, lan):
    """What waited meanwhile comes at once, and the clocks are known as before."""
    desk = Desk(pair, "aged", RTPUS, host="b")
    lengths = random.Random(1)
    try:
        desk.spawn("arm0", "src", "tells_time", out="Z0", freq=500.0)
        robot = {"invar": "Z0", "critical": True, "freq": 500.0}
        desk.on("arm0", "src")
        desk.spawn("arm1", "robot", "acts_on_time", out="Y1", **robot)
        wait_for(lambda: not desk.value("arm1", "Z0").stale, "news")
        desk.on("arm1", "robot")
        for _ in range(15):
            lan.mute("a", "b")
            time.sleep(lengths.uniform(0.2, 0.8))
            lan.heal("a", "b")
            first = desk.value("arm1", "Z0").cycle
            wait_for(lambda f=first: desk.value("arm1", "Z0").cycle > f + 20, "news")
        oldest, stable = desk.value("arm1", "Y1").values
        assert stable, "no cut was noticed"
        assert oldest < MAXAGE + STALL
    finally:
        lan.heal_all()
        pair.wait_all()
        desk.close()


@pytest.mark.parametrize("how", [Lan.cut, Lan.mute])
def test_a_cable_is_pulled_and_plugged_in_again(cell, lan, how):
    """Or it carries nothing any more, and neither end is told."""
    how(lan, "a", "b")
    for rtpu in RTPUS:
        wait_stable(cell, rtpu)
    for rtpu, host, lost in (("arm1", "host-a", "Y2 Z0"), ("arm0", "host-b", "Z2")):
        cause = f"host {host} is unreachable; no task writes {lost}"
        wait_for(lambda r=rtpu, c=cause: c in cell.illegal(r), "the agent's own cause")
    lan.heal("a", "b")
    wait_healed(cell)
    assert cell.status("arm0", "src").state == "ON"


def test_a_split_in_which_both_sides_write(cell, lan, lab):
    """Neither is believed when they meet; the master turns one off, and all is well."""
    lan.cut("a", "b")
    wait_for(lambda: "is unreachable" in cell.illegal("arm1"), "the flag")
    cell.spawn("arm1", "two", "counts", out="Z0")
    cell.on("arm1", "two")
    wait_for(lambda: "Z0" not in cell.illegal("arm1"), "a writer on this side")
    lan.heal("a", "b")
    fight = "Z0 is written on two machines"
    wait_for(lambda: fight in cell.illegal("arm1"), "the fight on b")
    lab.wait_reached("arm0", "b")
    wait_for(lambda: fight in cell.illegal("arm0"), "the fight on a")
    assert cell.value("arm0", "Z0").writer == "src"
    assert cell.value("arm1", "Z0").writer == "two"
    cell.off("arm1", "two")
    wait_healed(cell)


def test_masters_on_both_sides_of_a_cut_that_command_the_contrary(pair, lan):
    """Each has its side; where both have a writer when they meet, nothing is taken."""
    left = Desk(pair, "cell", RTPUS, host="a")
    chance, both = random.Random(14), 0
    try:
        left.spawn("arm0", "src", "counts", out="Z0")
        left.spawn("arm1", "two", "counts", out="Z0")
        spawn_critical(left, "arm1")
        left.on("arm0", "src")
        left.on("arm1", "sink")
        for _ in range(ROUNDS):
            wait_steady(left)
            lan.cut("a", "b")
            right = Desk(pair, "cell", (), host="b")
            right.rtpus = list(RTPUS)
            wait_for(lambda r=right: claimed(r, "arm1"), "the claim on b")
            if not (here := chance.random() < 0.7):
                left.off("arm0", "src")
            if there := chance.random() < 0.7:
                right.on("arm1", "two")
            lan.heal("a", "b")
            pair.wait_all()
            with pytest.raises(ClaimError):
                left.control("arm1", "two", "off" if there else "on")
            writers = {WHERE["src"]} if here else set()
            writers |= {WHERE["two"]} if there else set()
            both += here and there
            wait_for(lambda w=writers: agree(left, w), f"the writers {writers}")
            if there:
                right.off("arm1", "two")
            right.token.undeclare()
            wait_for(lambda: claimed(left, "arm1"), "the claim of the first one")
            if not here:
                left.on("arm0", "src")
        assert both >= ROUNDS / 4
    finally:
        lan.heal_all()
        pair.wait_all()
        left.close()


def claimed(desk, rtpu):
    """Claim an RTPU; return whether it was granted."""
    try:
        desk.claim(rtpu)
    except ClaimError:
        return False
    return True


def agree(desk, writers):
    """Return whether both machines know who writes Z0, or that two do."""
    fight = "Z0 is written on two machines"
    if len(writers) > 1:
        return all(fight in desk.illegal(rtpu) for rtpu in RTPUS)
    seen = {desk.value(rtpu, "Z0").writer for rtpu in RTPUS}
    seen = {one if "@" in one or not one else WHERE[one] for one in seen}
    return seen == (writers or {""}) and not any(
        fight in desk.illegal(rtpu) for rtpu in RTPUS
    )


def test_a_slow_cable_is_no_loss(cell, lan, lab):
    """News come late and are as old as they are; no machine is unreachable."""
    lan.slow("a", "b", 0.04)
    try:
        wait_for(lambda: trip(lab) > 0.07, "round trips that take their time")
        first = cell.value("arm1", "Z0")
        late = [first]
        while late[-1].cycle < first.cycle + 100:
            late.append(cell.value("arm1", "Z0"))
        assert min(one.age for one in late) > 0.02
        for rtpu in RTPUS:
            wait_steady(cell, rtpu)
            wait_for(
                lambda r=rtpu: "is unreachable" not in cell.illegal(r),
                "who was lost in a standstill to be seen",
            )
    finally:
        lan.quick()
    wait_healed(cell)
    wait_for(lambda: cell.value("arm1", "Z0").age < 0.02, "news in time")


def trip(lab):
    """Return how long a message from arm1 to arm0 and back takes at best."""
    report = lab.client("b").call("arm1", m.Links(), m.LinkReport)
    return min((way.trip for way in report.ways), default=0.0)


def test_the_agent_of_the_writer_is_killed(cell, lab, runs):
    rtpu = lab.info("arm0", "b").rtpu_pid
    lab.kill("arm0")
    wait_stable(cell, "arm1")
    assert alive(rtpu)  # control goes on without its agent
    lab.start("arm0", "a", grace=GRACE, runs=runs)
    wait_healed(cell)
    assert lab.info("arm0", "b").rtpu_pid == rtpu


def test_the_agent_of_the_reader_is_killed(cell, lab):
    """Its RTPU process sees that no agent transfers the variable, and says so at "
    "once."""
    rtpu = lab.info("arm1", "b").rtpu_pid
    cell.host = "a"
    lab.kill("arm1")
    wait_stable(cell, "arm0")
    lab.start("arm1", "b", connect=[lab.endpoint("a", "b")], grace=GRACE)
    lab.wait_all()
    wait_healed(cell)
    assert cell.events("arm1", "AGENT_GONE")
    assert lab.info("arm1", "b").rtpu_pid == rtpu


@pytest.mark.parametrize(("lost", "other"), [RTPUS, RTPUS[::-1]])
def test_an_rtpu_process_is_killed(cell, lab, lost, other):
    """Its tasks turn themselves off and end; nothing of them is left."""
    info = lab.info(lost)
    tasks = [task.tid for task in cell.look(lost, m.Status(), m.RtpuStatus).tasks]
    fork_server = fork_server_of(info.rtpu_pid)
    os.kill(info.rtpu_pid, signal.SIGKILL)
    wait_stable(cell, other)
    for pid in (*tasks, fork_server):
        wait_for(lambda p=pid: not alive(p), "the end of its tasks")
    restarted = wait_for(
        lambda: (now := lab.info(lost)).rtpu_pid not in {0, info.rtpu_pid} and now,
        "another RTPU process",
    )
    assert restarted.pid == info.pid
    lab.wait_no_orphans()


@pytest.mark.parametrize(("lost", "other"), [RTPUS, RTPUS[::-1]])
def test_processes_are_killed_in_turn(cell, lab, lost, other):
    """A task, and the fork server of its RTPU: both sides act, and all heals."""
    rtpu, task = lab.info(lost).rtpu_pid, {"arm0": "src", "arm1": "sink"}[lost]
    os.kill(cell.status(lost, task).tid, signal.SIGKILL)
    wait_stable(cell, other)
    lab.wait_no_orphans()
    bring_back(cell, lost, task)
    wait_healed(cell)
    tasks = [one.tid for one in cell.look(lost, m.Status(), m.RtpuStatus).tasks]
    os.kill(fork_server_of(rtpu), signal.SIGKILL)
    wait_stable(cell, other)
    for pid in tasks:
        wait_for(lambda p=pid: not alive(p), "the end of its tasks")
    lab.wait_no_orphans()
    for name in {"arm0": ("src", "back"), "arm1": ("sink",)}[lost]:
        bring_back(cell, lost, name)
    wait_healed(cell)
    assert cell.events(lost, "FORK_SERVER_DIED")
    assert lab.info(lost).rtpu_pid == rtpu


def test_the_recorder_is_killed(cell, lab):
    """Another one goes on, and control is not touched."""
    cell.ask("arm0", m.Record(run="lost"), m.Recorded)
    (recorder,) = lab.processes("a", "pbonet.node.recorder.recorder_process")
    os.kill(recorder, signal.SIGKILL)
    wait_for(lambda: cell.events("arm0", "RECORDER_DIED"), "news of its end")
    wait_for(
        lambda: lab.processes("a", "pbonet.node.recorder.recorder_process"),
        "another recorder",
    )
    wait_healed(cell)
    cell.ask("arm0", m.Record(mode="off"), m.Recorded)


def bring_back(desk, rtpu, task):
    """Spawn a task once more, and turn it on."""
    wait_for(lambda: has_ended(desk, rtpu, task), "its end")
    if task == "src":
        desk.spawn(rtpu, task, "counts", out="Z0")
    else:
        spawn_critical(desk, rtpu)
    desk.on(rtpu, task)


def has_ended(desk, rtpu, task):
    """Tell whether a task has died."""
    return desk.status(rtpu, task).state == "NOT-CREATED"


def test_another_agent_of_the_machine_carries_on(pair, runs):
    """Two agents on one machine: the one that carries the table is killed."""
    more = {"connect": [pair.endpoint("b", "a")], "listen": (), "grace": GRACE}
    pair.start("arm2", "a", **more)
    pair.wait_all()
    with contextlib.ExitStack() as after:
        after.callback(pair.stop, "arm2")
        cell = Desk(pair, "cell", ("arm0", "arm1", "arm2"), host="b")
        after.callback(cell.close)
        cell.spawn("arm0", "src", "counts", out="Z0")
        cell.on("arm0", "src")
        wait_for(lambda: carried(cell, "arm0"), "the first agent to carry it")
        assert not carried(cell, "arm2")
        pair.kill("arm0")
        wait_for(lambda: carried(cell, "arm2"), "the second agent to carry it")
        wait_for(lambda: not cell.illegal("arm1"), "healing")
        before = cell.value("arm1", "Z0").cycle
        wait_for(lambda: cell.value("arm1", "Z0").cycle > before, "news of src")
        assert not cell.value("arm1", "Z0").stale
        pair.start("arm0", "a", grace=GRACE, runs=runs)
        pair.wait_reached("arm0", "b")
        assert not carried(cell, "arm0")


def carried(cell, rtpu):
    """Return what an RTPU's agent has carried from other machines."""
    return cell.look(rtpu, m.Links(), m.LinkReport).tables


def test_a_master_that_vanishes_changes_nothing(cell, lab):
    cell.token.undeclare()
    lab.forget_session("b")
    before = cell.status("arm1", "sink").cycle
    wait_for(lambda: cell.status("arm1", "sink").cycle > before + 20, "cycles of sink")
    wait_healed(cell)


def test_an_agent_that_stays_away_leaves_everything_off(own_lab):
    """The grace ends, `off` runs, and no process is left on its machine."""
    own_lab.start("arm0", "a", grace=0.3)
    desk = Desk(own_lab, "cell", ("arm0",))
    diary = own_lab.run_dirs["a"].parent / f"{own_lab.domain}.diary"
    desk.spawn("arm0", "src", "counts", out="Y0", local={"diary": diary})
    desk.on("arm0", "src")
    own_lab.kill("arm0")
    wait_for(lambda: not own_lab.orphans(), "the end of all")
    assert "off" in diary.read_text()
    diary.unlink()


def test_critical_tasks_of_a_machine_without_the_keeper_run_stable(pair, lan):
    """They read nothing of another machine, so only ALONE can end their cycles."""
    desk = Desk(pair, "cell", RTPUS, host="b", alone=0.6)
    try:
        desk.spawn("arm1", "src", "counts", out="Z0")
        spawn_critical(desk, "arm1")
        for task in ("src", "sink"):
            desk.on("arm1", task)
        level = partial(desk.value, "arm1", "Z2")
        wait_for(lambda: level().values[0] == 1.0, "cycles")
        lan.cut("a", "b")
        wait_for(lambda: level().values[0] == -1.0, "stable()")
        cause = "no sign of life from RTPU arm0 for 0.6 s (ALONE)"
        assert cause in desk.illegal("arm1")
        assert not desk.illegal("arm0"), "the keeper's machine goes on"
        assert f"cell: {cause}" in desk.events("arm1", "ILLEGAL")
        lan.heal("a", "b")
        wait_for(lambda: level().values[0] == 1.0, "cycles again")
        assert not desk.illegal("arm1")
        assert f"cell: no longer: {cause}" in desk.events("arm1", "LEGAL")
    finally:
        lan.heal_all()
        pair.wait_all()
        desk.close()


def test_a_stop_reaches_a_machine_that_comes_back(cell, lab, lan):
    cell.look("arm0", m.Links())  # it greets the other one, as it does every second
    lan.cut("a", "b")
    wait_for(lambda: "arm1" not in lab.seen("a"), "the loss of arm1")
    ended = lab.cli("a", "stop", "cell")
    assert ended.returncode == 1
    assert "an RTPU did not confirm the stop" in ended.stderr
    assert "may still be ON: arm1: sink" in ended.stderr
    assert "arm0 of host-a has not seen arm1 of host-b" in ended.stderr
    assert cell.status("arm1", "sink").state == "ON"
    assert cell.look("arm0", m.Status(), m.RtpuStatus).tasks == []
    lan.heal_all()
    wait_for(
        lambda: not cell.look("arm1", m.Status(), m.RtpuStatus).tasks,
        "the end of the tasks of arm1",
    )
    late = "has reached arm1 only now: sink turned off"
    wait_for(lambda: late in str(cell.events("arm0", "STOPPED")), "the report")
    lab.wait_all()
    again = lab.cli("a", "stop", "cell")
    assert again.returncode == 0, again.stderr
    spawn_critical(cell, "arm1")
    assert cell.on("arm1", "sink").state == "ON", "it is carried out once"
