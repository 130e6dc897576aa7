"""Standbys that the dispatcher releases when their originals fail."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
from nodekit import rmod, svar, wait_gone
from watching import states, wait_for

from pbonet.errors import PbonetError, SvarOwnerError
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.svar import Table
from pbonet.xm.net import messages as m

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
JOB = """
JOB  watch
DESC a task and its standby
SBS  t.sbs
TASK first arm0 FALLBACK second
TASK hold  arm0
EOF
"""


FAILS = """
    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector


    class Fails(PortBasedObject):
        y: A[Vector, OutVar("Y", "2", "none", "cycles")]
        more: A[Vector, OutVar("Y5", "2", "none", "what its fallback does not write")]

        def cycle(self, dt: float) -> None:
            raise ZeroDivisionError("no cycle works")
"""
HANGS = """
    import time
    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector


    class Hangs(PortBasedObject):
        y: A[Vector, OutVar("Y", "2", "none", "cycles")]

        def on(self) -> None:
            print("in on", flush=True)
            while True:
                time.sleep(0.005)

        def cycle(self, dt: float) -> None:
            self.y[0] += 1.0
"""
WAITS = """
    import time
    from pathlib import Path
    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector


    class Waits(PortBasedObject):
        y: A[Vector, OutVar("Y", "2", "none", "cycles")]

        def on(self) -> None:
            Path("{begun}").touch()
            while not Path("{go_on}").exists():
                time.sleep(0.005)

        def cycle(self, dt: float) -> None:
            self.y[0] += 1.0
"""


@pytest.fixture
def start(nodes, tmp_path):
    """Start the job with these modules as the original and the standby."""
    opened = []

    def one(first, second="counts", freq=200.0, text=None, *, more="", standby=None):
        nodes.agent_processes("arm0", "arm1")
        (tmp_path / "t.sbs").write_text(SBS)
        (tmp_path / "t.svar").write_text(svar())
        (tmp_path / "watch.job").write_text(JOB)
        hold = {"invar": "Y0", "critical": True, "local": {"LEVEL": 3}}
        texts = {
            "first": text or rmod(first, freq=freq).replace("R Y\n", f"R Y {more}\n"),
            "second": standby or text or rmod(second, freq=freq),
            "hold": rmod("holds", "Y1", freq, **hold),
        }
        for name, lines in texts.items():
            (tmp_path / f"{name}.rmod").write_text(lines)
        arm = Subsystem(
            tmp_path / "t.sbs",
            domain=nodes.domain,
            libraries=nodes.config("arm0").libraries,
            warned=lambda _text: None,
        ).open()
        opened.append(arm)
        arm.start("watch")
        return arm

    yield one
    for arm in opened:
        arm.finish()


def events(arm, code):
    got = arm.clients.call("arm0", m.Events(), list[m.Event])
    return [event.text for event in got if event.code == code]


def told(arm, count=1):
    """Return the texts about fallbacks, once there are so many."""
    return wait_for(
        lambda: len(found := events(arm, "FALLBACK")) >= count and found,
        f"{count} events of a fallback",
    )


def causes(arm):
    return {cause for rtpu in arm.rtpu_status() for cause in rtpu.illegal}


def wait_standing(arm, standby="second"):
    wait_for(lambda: arm.status(standby).stands_by, f"{standby} standing by")


def wait_states(arm, **wanted):
    """Wait for what tasks say of themselves, each in its own time."""
    wait_for(lambda: states(arm) == wanted, f"the states {wanted}")


def test_an_error_releases_the_standby(start):
    arm = start("raises_in_cycle", freq=2.5)  # 4 s until it does
    wait_standing(arm)
    (text,) = told(arm)
    assert text.startswith("first is in ERROR: its fallback second was released by the")
    assert "state ON, time 1 of 3" in text
    wait_states(arm, first="ERROR", second="ON", hold="ON")
    assert arm.display(["Y0"])[0].writer == "second"
    wait_for(lambda: not causes(arm), "the flag to go down")
    # the original does not take its place back, and nobody stands by for the standby
    arm.control("first", "clear")
    assert states(arm) == {"first": "OFF", "second": "ON", "hold": "ON"}
    assert not arm.status("second").stands_by
    with pytest.raises(PbonetError, match="second"):
        arm.control("first", "on")


def test_an_error_in_the_very_first_cycle_releases_the_standby(start, nodes):
    """It stands by before its original comes on, however that does and how often.

    It writes less, too: nobody reads the rest, so that no flag stands for it.
    """
    nodes.write_module("fails_at_once", FAILS)
    arm = start("fails_at_once", more="Y5")  # with the job
    assert "state ON, time 1 of 3" in told(arm)[-1]
    wait_states(arm, first="ERROR", second="ON", hold="ON")
    wait_for(lambda: not causes(arm), "the flag to go down")
    assert arm.status("first").cycle == 0
    arm.control("first", "clear")
    arm.control("second", "off")
    arm.control("first", "on")  # by hand
    assert "state ON, time 2 of 3" in told(arm, 2)[-1]
    wait_states(arm, first="ERROR", second="ON", hold="ON")
    wait_for(lambda: not causes(arm), "the flag to go down")


def test_a_fallback_that_hands_over_to_its_original_is_ready_behind_it(
    start, nodes, tmp_path
):
    """Its own end takes long; its original has failed before anybody hears of that."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    nodes.write_module("fails_at_once", FAILS)
    lines = rmod("waits_in_collection", local={"BEGUN": begun, "GO_ON": go_on})
    arm = start("fails_at_once", more="Y5", standby=lines)
    told(arm)
    wait_states(arm, first="ERROR", second="ON", hold="ON")
    arm.control("first", "clear")
    with ThreadPoolExecutor(1) as pool:
        swap = pool.submit(arm.swap, "second", "first")
        try:
            wait_for(begun.exists, "the collection behind off")
            wait_for(lambda: states(arm)["first"] == "ERROR", "that the original fails")
        finally:
            go_on.touch()
        assert swap.result(60.0).items == [("second", "off"), ("first", "on")]
    assert "state ON, time 2 of 3" in told(arm, 2)[-1]
    wait_states(arm, first="ERROR", second="ON", hold="ON")
    wait_for(lambda: not causes(arm), "the flag to go down")


def test_what_the_master_has_raised_goes_down_by_itself(start, nodes, tmp_path):
    """It looked behind a swap, before the fallback wrote; then it has gone."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    nodes.write_module("fails_at_once", FAILS)
    nodes.write_module("waits_in_on", WAITS.format(begun=begun, go_on=go_on))
    go_on.touch()
    arm = start("fails_at_once", "waits_in_on", more="Y5")
    told(arm)
    wait_states(arm, first="ERROR", second="ON", hold="ON")
    arm.control("first", "clear")
    (tmp_path / "third.rmod").write_text(rmod("counts", freq=200.0))
    arm.spawn("third", "arm0")
    arm.swap("second", "third")
    begun.unlink()
    go_on.unlink()
    arm.swap("third", "first")  # in the place of another one than its fallback
    wait_for(begun.exists, "that the fallback is engaged")
    wait_states(arm, first="ERROR", second="OFF", hold="ON", third="OFF")
    arm.control("third", "kill")  # whatever makes the master look
    unfed = "equation 2: no task writes Y0 for hold (master)"
    assert unfed in causes(arm)
    arm.detach()
    go_on.touch()
    with Table.attach(f"{nodes.domain}.t") as table:
        wait_for(lambda: table.info("Y0").owner == "second", "the fallback to own Y0")
        wait_for(lambda: not table.illegal, "the flag to go down")
    arm.open()
    assert "state ON, time 2 of 3" in told(arm, 2)[-1]
    wait_for(
        lambda: (
            events(arm, "LEGAL").count(f"no longer: {unfed}")
            == events(arm, "ILLEGAL").count(unfed)
            >= 1
        ),
        "that its end is told",
    )


def test_a_killed_task_is_replaced_though_its_agent_is_dead(start, nodes):
    arm = start("counts")
    wait_standing(arm)
    before = {status.task: status for status in arm.status_all()}
    agent = nodes.processes.pop("arm0")
    agent.send_signal(signal.SIGKILL)
    agent.wait()
    with Table.attach(f"{nodes.domain}.t") as table:
        os.kill(before["first"].tid, signal.SIGKILL)
        wait_for(lambda: table.info("Y0").owner == "second", "the standby to own Y0")
        wait_for(lambda: table.info("Y0").cycle > 3, "cycles of the standby")
    nodes.agent_process("arm0")
    wait_for(
        lambda: "arm0" in arm.clients.client.rtpus(), "the master to see the agent"
    )
    (text,) = told(arm)
    assert text.startswith("first has died: its fallback second was released")
    assert {one.task: one.state for one in arm.status_all()}["second"] == "ON"
    assert arm.status("hold").on_ns == before["hold"].on_ns  # who stays noticed nothing
    wait_for(lambda: not causes(arm), "the flag to go down")
    cause = "first has died (arm0/first)"  # told, however briefly it was up
    wait_for(lambda: f"no longer: {cause}" in events(arm, "LEGAL"), "its end, told")
    assert cause in events(arm, "ILLEGAL")


def test_a_standby_that_fails_too_is_in_error_with_the_flag_up(start):
    arm = start("counts", "raises_in_on")
    wait_standing(arm)
    os.kill(arm.status("first").tid, signal.SIGKILL)
    (text,) = told(arm)
    assert "state ERROR" in text
    assert "no task writes its variables" in text
    assert states(arm)["second"] == "ERROR"
    wait_for(lambda: "first has died (arm0/first)" in causes(arm), "the flag")
    assert "first has died (arm0/first)" in events(arm, "ILLEGAL")
    wait_for(lambda: arm.display(["Y1"])[0].values[0] == -1.0, "stable")
    arm.control("second", "clear")  # an operator may try once more
    assert states(arm)["second"] == "OFF"
    assert len(told(arm)) == 1


def test_a_standby_that_hangs_in_on_can_be_killed(start, nodes):
    nodes.write_module("hangs", HANGS)
    arm = start("counts", "hangs")
    wait_standing(arm)
    os.kill(arm.status("first").tid, signal.SIGKILL)
    wait_for(lambda: "in on" in events(arm, "OUTPUT"), "that it is engaged")
    by_force = m.Control(task="second", signal="kill", timeout=1.0)
    arm.clients.call("arm0", by_force, m.TaskStatus)
    wait_for(lambda: len(events(arm, "TASK_DIED")) == 1, "the news of the first")
    assert states(arm) == {"first": "NOT-CREATED", "hold": "ON"}
    assert causes(arm) == {"first has died (arm0/first)"}


def test_nothing_flaps(start):
    arm = start("counts")
    for time in (1, 2, 3):
        wait_standing(arm)
        os.kill(arm.status("first").tid, signal.SIGKILL)
        assert f"time {time} of 3" in told(arm, time)[-1]
        wait_for(lambda time=time: len(events(arm, "TASK_DIED")) == time, "the news")
        arm.spawn("first", "arm0")
        arm.swap("second", "first")
        assert states(arm) == {"first": "ON", "second": "OFF", "hold": "ON"}
    assert told(arm, 3)[-1].endswith("second will not stand by again")
    first = arm.status("first").tid
    os.kill(first, signal.SIGKILL)
    wait_gone([first])
    wait_for(lambda: "first has died (arm0/first)" in causes(arm), "the flag")
    assert states(arm)["second"] == "OFF"
    assert len(told(arm, 3)) == 3


def test_what_is_ended_in_order_is_not_replaced(start):
    arm = start("counts")
    wait_standing(arm)
    arm.control("first", "off")
    assert states(arm)["second"] == "OFF"
    arm.control("first", "on")
    wait_standing(arm)
    arm.control("first", "kill")
    assert states(arm) == {"second": "OFF", "hold": "ON"}
    assert not events(arm, "FALLBACK")
    arm.control("second", "on")  # by hand it can be had at any time
    assert arm.display(["Y0"])[0].writer == "second"


def test_a_standby_obeys_while_it_stands_by(start, tmp_path):
    """Also a switch to a job that does not name it."""
    arm = start("counts")
    wait_standing(arm)
    alone = JOB.replace("JOB watch", "JOB alone").replace(" FALLBACK second", "")
    (tmp_path / "alone.job").write_text(alone)
    arm.switch("alone")
    second = arm.status("second")
    assert (second.state, second.fallback_of) == ("OFF", "")
    assert not second.stands_by
    arm.switch("watch")
    wait_standing(arm)
    assert arm.freq("second", 100.0) == 100.0
    assert len(arm.get("second")) == 1
    wait_standing(arm)
    by_hand = m.Control(task="second", signal="on")
    with pytest.raises(SvarOwnerError):
        arm.clients.call("arm0", by_hand, m.TaskStatus)
    wait_standing(arm)  # it stands by again
    arm.control("second", "kill")
    assert states(arm) == {"first": "ON", "hold": "ON"}
    arm.control("first", "kill")
    assert states(arm) == {"hold": "ON"}


@pytest.mark.parametrize("kind", ["synchronous", "sporadic", "deferrable"])
def test_a_standby_that_is_timed_from_outside_takes_the_events_over(
    start, tmp_path, kind
):
    device = tmp_path / "device"
    os.mkfifo(device)
    fd = os.open(device, os.O_RDWR)
    lines = rmod("overruns", freq=20.0, local={"FIFO": device, "EVERY": 1000})
    capacity = "CAPACITY 0.02\n" * (kind != "synchronous")
    text = lines.replace("periodic", kind).replace("LOCAL", f"{capacity}LOCAL")
    try:
        arm = start("overruns", text=text)

        def served(count, whom):
            os.write(fd, b"x")
            wait_for(
                lambda: (
                    (now := arm.display(["Y0"])[0]).values[0] == count
                    and now.writer == whom
                ),
                f"event {count} served by {whom}",
            )

        served(1, "first")
        served(2, "first")
        wait_standing(arm)
        os.kill(arm.status("first").tid, signal.SIGKILL)
        told(arm)
        served(3, "second")  # it goes on from the value in the table
        served(4, "second")
        wait_for(lambda: len(events(arm, "TASK_DIED")) == 1, "the news of its death")
        wanted = {"first": "NOT-CREATED", "second": "ON", "hold": "ON"}
        assert states(arm) == wanted
    finally:
        os.close(fd)


def test_a_standby_that_died_stands_by_again_once_it_is_spawned_anew(start):
    arm = start("counts")
    wait_standing(arm)
    dead = arm.status("second").tid
    os.kill(dead, signal.SIGKILL)
    wait_gone([dead])
    wait_for(lambda: len(events(arm, "TASK_DIED")) == 1, "the news of its death")
    assert states(arm) == {"first": "ON", "second": "NOT-CREATED", "hold": "ON"}
    assert not causes(arm)  # nobody depends on it
    arm.spawn("second", "arm0")
    wait_standing(arm)
    os.kill(arm.status("first").tid, signal.SIGKILL)
    assert "state ON, time 1 of 3" in told(arm)[-1]
    assert states(arm)["second"] == "ON"


def test_when_both_die_the_flag_is_up_and_the_rest_goes_on(start):
    arm = start("counts")
    wait_standing(arm)
    both = [arm.status(name).tid for name in ("second", "first")]
    for pid in both:
        os.kill(pid, signal.SIGKILL)
    wait_gone(both)
    wait_for(lambda: len(events(arm, "TASK_DIED")) == 2, "the news of both")
    wait_for(lambda: "first has died (arm0/first)" in causes(arm), "the flag")
    wait_for(lambda: arm.display(["Y1"])[0].values[0] == -1.0, "stable")
    assert states(arm) == {
        **dict.fromkeys(("first", "second"), "NOT-CREATED"),
        "hold": "ON",
    }
    arm.spawn("second", "arm0")
    arm.control("second", "on")
    wait_for(lambda: not causes(arm), "the flag to go down")


GOES_ON = """
    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector


    class GoesOn(PortBasedObject):
        y: A[Vector, OutVar("Y", "2", "none", "what it has found, and its cycles")]

        def on(self) -> None:
            self.found = self.y.copy()

        def cycle(self, dt: float) -> None:
            self.y[0] = self.found.sum()
            self.y[1] += 1.0
"""


@pytest.mark.parametrize("how", ["raises", "dies"])
def test_a_fallback_finds_the_safe_values_of_the_failed_cycle(start, nodes, how):
    """They come with the failure, the fallback with the end; late values never do."""
    nodes.write_module("goes_on", GOES_ON)
    work = {"raises": "python", "dies": "endless"}[how]
    late = {"work": work, "busy": 0.05, "answer": "raise", "every": 20}
    first = rmod("overruns", freq=50.0, local=late)
    first = first.replace("FREQ 50\n", "FREQ 50\nSAFE deadline\n")
    arm = start("overruns", text=first, standby=rmod("goes_on", freq=50.0))
    if how == "dies":  # a hanging task keeps its variables until it ends
        status = wait_for(
            lambda: (found := arm.status("first")).made_safe and found, "safe values"
        )
        assert not events(arm, "FALLBACK")
        assert tuple(arm.display(["Y0"])[0].values) == (-7.0, -7.0)
        os.kill(status.tid, signal.SIGKILL)
    assert "state ON, time 1 of 3" in told(arm)[-1]
    wait_for(lambda: arm.display(["Y0"])[0].values[0] == -14.0, "what it has found")
    assert arm.display(["Y0"])[0].writer == "second"
    if how == "dies":
        wait_for(lambda: events(arm, "LEFT_SAFE"), "word of the safe values")
    wait_for(lambda: not causes(arm), "the flag to go down")
