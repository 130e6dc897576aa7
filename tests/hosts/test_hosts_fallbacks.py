"""A machine with an original is lost, and its fallback on another one takes over.

arm0 on a has the CRITICAL original, which reads nothing, so that only ALONE ends its
cycles. arm1 on b has the standby, and the keeper unless arm2 on c has it. What the two
do is in their diaries, by one clock.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time

import pytest
from nodekit import rmod, svar
from watching import states, wait_for

from pbonet.errors import PbonetError, VerificationError
from pbonet.master import Subsystem
from pbonet.testing.lan import Lan
from pbonet.xm.net import messages as m

ALONE = 0.6
GRACE = 30.0
JOB = """
JOB  watch
DESC a task, and its standby on another machine
SBS  t.sbs
TASK first arm0 FALLBACK second {takeover}
TASK hold  arm1
EOF
"""
TAKES_OVER = "TAKEOVER 2.5"
LONGER = 4.0
"""Seconds after which nothing is expected any more."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return str(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def hosts(lab, lan, runs):
    """arm1 on b, and arm0 on a, which it dials; arm2 on c, which dials both."""
    lan.heal_all()
    lab.tend("arm0", "a", runs=runs, grace=GRACE)
    lab.tend("arm1", "b", connect=[lab.endpoint("a", "b")], runs=runs)
    both = [lab.endpoint("a", "c"), lab.endpoint("b", "c")]
    lab.tend("arm2", "c", connect=both, runs=runs)
    lab.wait_all()
    for rtpu in lab.agents:
        wait_for(lambda r=rtpu: lab.info(r).rtpu_pid, f"the RTPU process of {rtpu}")
    yield lab
    lan.heal_all()
    lab.wait_no_orphans()


@pytest.fixture
def start(hosts, tmp_path):
    """Start the job by a master on host b."""
    opened = []

    def one(takeover="", keeper="arm1"):
        rtpus = "".join(f"RTPU arm{n}\n" for n in range(3))
        (tmp_path / "t.sbs").write_text(
            f"SUBSYSTEM t\nSVARFILE t.svar\nMASTER {keeper}\nALONE {ALONE}\n"
            f"{rtpus}EOF\n"
        )
        (tmp_path / "t.svar").write_text(svar())
        (tmp_path / "watch.job").write_text(JOB.format(takeover=takeover))
        diaries = {name: tmp_path / f"{name}.diary" for name in ("first", "second")}
        texts = {
            name: rmod("drives", critical=True, local={"DIARY": diary})
            for name, diary in diaries.items()
        }
        texts["second"] = texts["second"].replace("LOCAL", "RTPU arm1\nLOCAL")
        hold = {"invar": "Y0", "local": {"LEVEL": 3}}
        texts["hold"] = rmod("holds", "Y1", **hold)
        for name, lines in texts.items():
            (tmp_path / f"{name}.rmod").write_text(lines)
        arm = Subsystem(
            tmp_path / "t.sbs",
            domain=hosts.domain,
            connect=[f"unixsock-stream/{hosts.run_dirs['b'] / hosts.domain}/arm1.sock"],
            libraries=[tmp_path],
            warned=warnings.append,
        ).open()
        opened.append(arm)
        arm.start("watch")
        wait_for(lambda: notes("first"), "cycles of first")
        return arm

    def notes(task):
        """Return what a task has done: time and word."""
        diary = tmp_path / f"{task}.diary"
        if not diary.exists():
            return []
        lines = [line.split() for line in diary.read_text().splitlines()]
        return [(float(at), what) for at, what in lines]

    warnings = []
    one.notes, one.warnings = notes, warnings
    yield one
    hosts.lan.heal_all()
    try:
        hosts.wait_all()
    finally:  # else each test after this one fails, too
        for arm in opened:
            with contextlib.suppress(PbonetError):
                if not arm.is_open:  # a test that failed while it was detached
                    arm.open()
                arm.finish()


def left(hosts, name):
    """Return the orders that an agent keeps for RTPUs which have not obeyed."""
    folder = hosts.run_dirs[hosts.agents[name][0]] / "state"
    file = folder / hosts.domain / f"{name}.json"
    with contextlib.suppress(FileNotFoundError):
        return json.loads(file.read_text())["orders"]
    return []


def words(notes):
    return [what for _, what in notes]


def gave_way(start, *then):
    """Judge that the original was stable before the standby wrote, then did `then`.

    Before that it may have been stable for a time: a machine that stands still loses
    its links for a moment.
    """
    first, ((begun, _), *_) = start.notes("first"), start.notes("second")
    assert words(one for one in first if one[0] < begun)[-1] == "stable"
    assert words(one for one in first if one[0] >= begun) == [*then]


def writer(arm, rtpu):
    """Return who writes Y0 on an RTPU's machine, asked by way of b."""
    request = m.Display(names=["Y0"])
    return arm.clients.call(rtpu, request, list[m.VarValue])[0].writer


def causes(arm):
    return [cause for rtpu in arm.rtpu_status() for cause in rtpu.illegal]


def events(arm, rtpu, code):
    got = arm.clients.call(rtpu, m.Events(), list[m.Event])
    return [event.text for event in got if event.code == code]


def reports(arm):
    """Return what arm1 and arm2 have reported of late orders, also in other tests.

    Both repeat an order. arm0 carries it out once, and says so to the first one.
    """
    found = [
        (event.time, event.text)
        for rtpu in ("arm1", "arm2")
        for event in arm.clients.call(rtpu, m.Events(), list[m.Event])
        if event.text.startswith("the order that others replace first, given ")
    ]
    return [text for _, text in sorted(found)]


def wait_replaced(arm, start):
    """Wait until the original is seen again, and has been turned off."""
    wait_for(lambda: state(arm, "first") == "OFF", "the end of first")
    wait_for(lambda: not causes(arm), "the flag to go down")
    for rtpu, name in (("arm0", "second@b"), ("arm1", "second")):
        wait_for(
            lambda r=rtpu, n=name: writer(arm, r).startswith(n.partition("@")[0]),
            f"{name} to write on the machine of {rtpu}",
        )
    assert words(start.notes("first"))[-1] == "off"


def state(arm, task):
    found = arm.clients.each(lambda _: m.Status(), m.RtpuStatus)[0].values()
    return {one.task: one.state for rtpu in found for one in rtpu.tasks}.get(task)


def one_way(lan, one, other):
    """Lose all that one host sends to another."""
    lan.lose(one, other)


def other_way(lan, one, other):
    lan.lose(other, one)


@pytest.mark.parametrize("how", [Lan.cut, Lan.mute, one_way, other_way])
def test_the_original_is_stable_before_the_standby_writes(start, lan, how):
    """And it never writes again: it is turned off before its flag goes down."""
    arm = start(TAKES_OVER)
    lan.cut("a", "c")
    wait_for(lambda: "second" in states(arm), "answers")
    how(lan, "a", "b")
    wait_for(lambda: "cycle" in words(start.notes("second")), "the takeover")
    gave_way(start)
    lan.heal_all()
    wait_replaced(arm, start)
    gave_way(start, "off")
    assert events(arm, "arm1", "FALLBACK")[-1].startswith("first on arm0 is lost")
    arm.swap("second", "first")
    assert states(arm)["first"] == "ON"
    assert arm.status("second").stands_by


def test_by_the_word_of_a_keeper_on_a_third_machine(start, lan):
    """As long as that one hears the original's machine nothing happens."""
    arm = start(TAKES_OVER, keeper="arm2")
    lan.lose("a", "b")
    lan.lose("b", "a")
    wait_for(lambda: reached(arm, "arm2"), "the keeper to be in reach")
    lan.cut("a", "c")
    wait_for(lambda: "cycle" in words(start.notes("second")), "the takeover")
    gave_way(start)
    lan.heal_all()
    wait_replaced(arm, start)
    gave_way(start, "off")


def reached(arm, rtpu):
    return rtpu in arm.clients.each(lambda _: m.Status(), m.RtpuStatus)[0]


def test_a_machine_without_the_keeper_takes_nothing_over(start, hosts, lan):
    """The one of the standby is cut off itself: its own CRITICAL tasks are stable."""
    arm = start(TAKES_OVER, keeper="arm2")
    lan.cut("a", "b")
    lan.cut("b", "c")
    here = hosts.client("b")
    wait_for(lambda: alone(here), "the flag on b")
    time.sleep(LONGER)
    assert start.notes("second") == []
    lan.heal_all()
    hosts.wait_all()
    wait_for(lambda: not causes(arm), "healing")
    wait_for(lambda: words(start.notes("first"))[-1] == "cycle", "cycles of first")
    assert arm.status("second").stands_by


def alone(client):
    status = client.call("arm1", m.Status(subsystem="t"), m.RtpuStatus)
    return any("ALONE" in cause for cause in status.illegal)


def test_swap_does_it_where_the_job_does_not_say_so(start, hosts, lan, tmp_path):
    """Also a master that is opened after the cut; the original is off once back."""
    arm = start()
    before = reports(arm)
    arm.detach()
    lan.cut("a", "c")
    lan.cut("a", "b")
    wait_for(lambda: "arm0" not in hosts.seen("b"), "the loss of arm0")
    done = hosts.cli("b", "swap", str(tmp_path / "t.sbs"), "first", "second")
    assert done.returncode == 0, done.stderr
    assert "judged without arm0" in done.stderr
    assert "first may still be ON on arm0, and will be turned off" in done.stderr
    wait_for(lambda: "cycle" in words(start.notes("second")), "cycles of second")
    lan.heal_all()
    hosts.wait_all()
    arm.open()
    wait_replaced(arm, start)
    for name in ("arm1", "arm2"):
        wait_for(lambda n=name: not left(hosts, n), f"{name} to have no order left")
    wait_for(lambda: reports(arm)[len(before) :], "the report")
    (text,) = reports(arm)[len(before) :]  # both repeat it; arm0 carries it out once
    assert text.endswith("has reached arm0 only now: first turned off")


def test_an_order_is_no_loss(start, hosts, lan):
    """Who was turned off before the cut is not replaced."""
    arm = start(TAKES_OVER)
    arm.control("first", "off")
    assert not arm.status("second").stands_by
    lan.cut("a", "c")
    lan.cut("a", "b")
    wait_for(lambda: "arm0" not in hosts.seen("b"), "the loss of arm0")
    time.sleep(LONGER)
    assert start.notes("second") == []
    lan.heal_all()
    hosts.wait_all()
    arm.control("first", "on")
    assert arm.status("second").stands_by


def test_the_rtpu_process_of_the_original_is_killed(start, hosts):
    """Its agent stays; the tasks of other machines see who writes."""
    arm = start(TAKES_OVER)
    os.kill(hosts.info("arm0").rtpu_pid, signal.SIGKILL)
    wait_for(lambda: "cycle" in words(start.notes("second")), "the takeover")
    assert words(start.notes("first"))[0] == "cycle"
    assert words(start.notes("first"))[-1] == "off"
    wait_for(lambda: not causes(arm), "the flag to go down")
    hosts.wait_no_orphans()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_the_agent_of_the_original_is_killed_or_stopped(start, hosts, how, runs):
    """Nobody can tell its machine anything then: its RTPU process raises the flag."""
    arm = start(TAKES_OVER)
    _, agent = hosts.agents["arm0"]
    agent.send_signal(how)
    try:
        wait_for(lambda: "cycle" in words(start.notes("second")), "the takeover")
        gave_way(start)
    finally:
        if how is signal.SIGKILL:
            hosts.kill("arm0")
            hosts.start("arm0", "a", runs=runs, grace=GRACE)
        else:
            agent.send_signal(signal.SIGCONT)
    wait_replaced(arm, start)
    gave_way(start, "off")


@pytest.mark.parametrize(
    ("takeover", "keeper", "said"),
    [
        ("TAKEOVER 1.5", "arm1", "must have ended its cycles before"),
        (TAKES_OVER, "arm0", "so it is never alone"),
    ],
)
def test_what_could_write_beside_the_original_does_not_start(
    start, takeover, keeper, said
):
    with pytest.raises(VerificationError, match=said):
        start(takeover, keeper)
    assert start.notes("first") == []
