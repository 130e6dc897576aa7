"""Standbys on another RTPU of the machine than their originals."""

from __future__ import annotations

import os
import signal
import time

import pytest
from nodekit import rmod, svar
from watching import states, wait_for

from pbonet.errors import PbonetError
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.xm.net import messages as m

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nMASTER arm1\nRTPU arm0\nRTPU arm1\nEOF\n"
JOB = """
JOB  watch
DESC a task, and its standby on another RTPU
SBS  t.sbs
TASK first arm0 FALLBACK second {takeover}
TASK hold  arm1
EOF
"""


@pytest.fixture
def opened():
    found = []
    yield found
    for arm in found:
        arm.detach()  # an RTPU that was lost knows no claim any more


@pytest.fixture
def start(nodes, tmp_path, opened):
    """Start the job; `reopen` opens the subsystem once more."""

    def one(takeover="", first="counts"):
        nodes.agent_processes("arm0", "arm1")
        (tmp_path / "t.sbs").write_text(SBS)
        (tmp_path / "t.svar").write_text(svar())
        (tmp_path / "watch.job").write_text(JOB.format(takeover=takeover))
        hold = {"invar": "Y0", "critical": True, "local": {"LEVEL": 3}}
        texts = {
            "first": rmod(first, freq=2.5 if first != "counts" else 200.0),
            "second": rmod("counts").replace("EOF", "RTPU arm1\nEOF"),
            "hold": rmod("holds", "Y1", **hold),
        }
        for name, lines in texts.items():
            (tmp_path / f"{name}.rmod").write_text(lines)
        arm = reopen()
        arm.start("watch")
        return arm

    def reopen():
        arm = Subsystem(
            tmp_path / "t.sbs",
            domain=nodes.domain,
            libraries=nodes.config("arm0").libraries,
            warned=warnings.append,
        ).open()
        opened.append(arm)
        return arm

    warnings = []
    one.reopen, one.warnings = reopen, warnings
    return one


def events(arm, rtpu, code):
    got = arm.clients.call(rtpu, m.Events(), list[m.Event])
    return [event.text for event in got if event.code == code]


def lose(nodes, arm, comes_back="OFF"):
    """Kill the RTPU process of the original, and wait until the task is back, OFF."""
    old = nodes.client().call("arm0", m.Hello(), m.AgentInfo).rtpu_pid
    os.kill(old, signal.SIGKILL)
    nodes.wait_restarted("arm0", old)
    wait_for(lambda: states(arm).get("first") == comes_back, "the end of first")


def wait_goes_on(arm, writer):
    wait_for(lambda: arm.display(["Y0"])[0].writer == writer, f"{writer} to write")
    wait_for(lambda: not causes(arm), "the flag to go down")


def causes(arm):
    return [cause for rtpu in arm.rtpu_status() for cause in rtpu.illegal]


def test_it_is_where_its_rmod_says(start):
    arm = start()
    second = arm.status("second")
    assert (second.rtpu, second.fallback_of, second.original_rtpu) == (
        "arm1",
        "first",
        "arm0",
    )
    assert second.stands_by
    assert states(arm) == {"first": "ON", "second": "OFF", "hold": "ON"}


def test_it_takes_over_by_itself_when_the_rtpu_process_is_killed(start, nodes):
    arm = start("TAKEOVER 0.5")
    lose(nodes, arm)
    wait_for(lambda: states(arm)["second"] == "ON", "the takeover")
    assert states(arm) == {"first": "OFF", "second": "ON", "hold": "ON"}
    wait_goes_on(arm, "second")
    (told,) = events(arm, "arm1", "FALLBACK")
    assert told.startswith("first on arm0 is lost, no task has written its variables")
    assert "its fallback second was turned on; state ON, time 1 of 3" in told


def test_it_does_not_where_the_job_does_not_say_so_and_swap_does(start, nodes, opened):
    arm = start("RESTART never")
    lose(nodes, arm, "NOT-CREATED")
    lost = {"first": "NOT-CREATED"}
    assert states(arm) == lost | {"second": "OFF", "hold": "ON"}
    opened.remove(arm)
    arm.detach()
    again = start.reopen()  # this one has never seen the original
    again.swap("first", "second")
    assert states(again) == lost | {"second": "ON", "hold": "ON"}
    wait_goes_on(again, "second")


def test_an_original_that_fails_is_replaced_as_one_that_is_lost(start):
    arm = start("TAKEOVER 0.5", "raises_in_cycle")
    wanted = {"first": "ERROR", "second": "ON", "hold": "ON"}
    wait_for(lambda: states(arm) == wanted, "the takeover")
    wait_goes_on(arm, "second")
    arm.control("first", "clear")
    assert not arm.status("second").stands_by


def test_an_original_that_comes_back_finds_its_standby_as_the_writer(start, nodes):
    """As when it is turned on, and no master judges that."""
    arm = start("TAKEOVER 0.5")
    lose(nodes, arm)
    wait_for(lambda: states(arm)["second"] == "ON", "the takeover")
    arm.detach()
    again = start.reopen()
    with pytest.raises(PbonetError, match="second"):
        again.clients.call("arm0", m.Control(task="first", signal="on"), m.TaskStatus)
    assert states(again)["first"] != "ON"
    wait_goes_on(again, "second")
    assert states(again)["second"] == "ON"


def test_swap_back_makes_it_stand_by_again_and_an_order_is_no_failure(start):
    arm = start("TAKEOVER 0.5")
    arm.swap("first", "second")
    assert states(arm) == {"first": "OFF", "second": "ON", "hold": "ON"}
    arm.swap("second", "first")
    assert arm.status("second").stands_by
    arm.control("first", "off")
    assert not arm.status("second").stands_by
    time.sleep(2.0)  # TAKEOVER, and a greeting
    assert states(arm)["second"] == "OFF"
    arm.control("first", "on")
    assert arm.status("second").stands_by
