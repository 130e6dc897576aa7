"""`pbonet explain` about real tasks."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import threading
from pathlib import Path

import pytest
from nodekit import rmod, svar
from watching import wait_for

from pbonet.errors import PbonetError
from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.console import Subsystem
from pbonet.xm.net import messages as m


@pytest.fixture
def arm(nodes, tmp_path):
    """A task that fails in its tenth cycle, and a CRITICAL one that reads it."""
    nodes.agent_processes("arm0")
    (tmp_path / "t.sbs").write_text("SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nEOF\n")
    (tmp_path / "t.svar").write_text(svar())
    (tmp_path / "first.rmod").write_text(rmod("raises_in_cycle", "Y0", 50.0))
    holds = rmod("holds", "Y1", 50.0, invar="Y0", critical=True, local={"LEVEL": 3})
    (tmp_path / "hold.rmod").write_text(holds)
    busy = rmod("overruns", "Y2", 50.0, local={"BUSY": 0.06, "EVERY": 2})
    (tmp_path / "busy.rmod").write_text(busy)
    with Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _: None,
    ) as opened:
        yield opened


@pytest.fixture
def asked(nodes, arm, tmp_path):
    """Explain to words, as text."""
    place = Place(domain=nodes.domain, libraries=arm.files.library.folders)

    def answer(*words, **how):
        return str(diagnosis.answer(tmp_path / "t.sbs", words, place, **how))

    return answer


def test_a_task_that_failed_and_the_flag_for_it(arm, asked):
    arm.spawn("first")
    assert "do: turn it on" in asked("first")
    arm.spawn("hold")
    arm.reconfig([("first", "on"), ("hold", "on")])
    wait_for(lambda: arm.status("first").state == "ERROR", "the task fails")
    wait_for(lambda: any(one.illegal for one in arm.rtpu_status()), "the flag is up")
    text = asked()
    order = [
        "the flag of t is up",
        "because first is in ERROR (arm0/first), on arm0 [status]",
        "because task first on arm0 is ERROR [status]",
        "ZeroDivisionError: the tenth cycle does not work",
        "METHOD of arm0/first",
        "do: 'clear first' brings it out of ERROR, 'kill first' removes it",
    ]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    arm.clear("first")
    assert "because STATE of arm0/first" in asked("first")
    assert "task first on arm0 is OFF" in asked("Y0"), "nobody writes it now"


@pytest.mark.parametrize("by", ["kill", "signal"])
def test_a_task_that_ended_in_a_cycle_with_safe_values(
    nodes, arm, tmp_path, by, briefly
):
    job = tmp_path / "late.job"
    job.write_text("JOB late\nDESC a late task\nSBS t.sbs\nTASK busy arm0\nEOF\n")
    place = Place(domain=nodes.domain, libraries=arm.files.library.folders)
    hangs = rmod("overruns", "Y2", 50.0, local={"WORK": "endless", "EVERY": 2})
    hangs = hangs.replace("FREQ 50\n", "FREQ 50\nSAFE deadline\n")
    (tmp_path / "busy.rmod").write_text(hangs)
    arm.spawn("busy")
    arm.on("busy")
    status = wait_for(
        lambda: (found := arm.status("busy")).made_safe and found, "safe values"
    )
    if by == "kill":
        with briefly():
            arm.kill("busy")
    else:
        os.kill(status.tid, signal.SIGKILL)
        wait_for(
            lambda: any(
                one.code == "TASK_DIED"
                for one in arm.clients.call("arm0", m.Events(), list[m.Event])
            ),
            "its death",
        )
    text = str(diagnosis.answer(job, ("busy",), place))
    assert re.search(
        r"LEFT_SAFE of arm0/busy at [\d:]+, cycle 1: the task has ended amid a cycle "
        r"that had failed in time; Y2 got the safe values [\d.]+ us after the failure",
        text,
    ), text
    assert "LEFT_SAFE" in str(diagnosis.answer(job, ("Y2",), place))
    (tmp_path / "busy.rmod").write_text(rmod("overruns", "Y2", 50.0))
    arm.spawn("busy")
    arm.kill("busy")
    text = str(diagnosis.answer(job, ("busy",), place))
    assert "LEFT_SAFE" not in text, "of an earlier process"


def test_cycles_that_are_missed(arm, asked):
    arm.spawn("busy")
    arm.on("busy")
    wait_for(lambda: arm.status("busy").miss > 2, "cycles are missed")
    text = asked("miss", "busy")
    assert "its longest cycle takes" in text
    assert "and its period is 20 ms [schedule]" in text
    assert "do: lower the rate, use a faster core, or shorten `cycle`" in text
    assert "the kernel's sched_switch" not in text, "it was not asked for"
    text = asked("miss", "busy", trace=20.0)
    assert "what the kernel counts" in text or re.search(
        r"core \d+ in [\d.]+ s: ", text
    )
    if "cannot be followed" in text:  # no root, or no tracefs
        assert re.search("not read: .*: the kernel's sched_switch cannot", text)
    else:
        had = re.search(r"it missed \d+ releases?; who had core \d+: (.*) ms", text)
        assert had is not None, text
        assert "busy " in had[1]
    assert not [*Path("/sys/kernel/tracing").glob("instances/pbonet-*")]


def test_a_core_is_followed_for_longer_than_a_request_waits_for_a_sign(
    arm, asked, tmp_path
):
    """The client repeats the request meanwhile, which is no second one."""
    os.mkfifo(tmp_path / "fifo")
    busy = rmod("overruns", "Y2", 50.0, local={"FIFO": tmp_path / "fifo"})
    busy = busy.replace("FREQ 50\n", "").replace("periodic", "background")
    (tmp_path / "busy.rmod").write_text(busy)
    arm.spawn("busy")
    assert "the background task busy has no period" in asked("miss", "busy", trace=9.0)
    arm.spawn("first")
    text = asked("miss", "first", trace=1.0)
    assert re.search(r", and none in the 1(\.\d+)? s in which it was followed", text)
    assert "for another request" not in text


def test_an_agent_that_is_killed_leaves_no_trace_on(nodes, arm):
    """Its RTPU process removes it, while it waits for another agent."""
    instances = Path("/sys/kernel/tracing/instances")
    if not os.access(instances, os.W_OK):
        pytest.skip("there is no tracefs, or it needs root")
    arm.spawn("first")
    process = nodes.processes["arm0"]
    here = instances / f"pbonet-{process.pid}"
    event = here / "events/sched/sched_switch/enable"

    def ask():
        with contextlib.suppress(PbonetError):  # the agent goes
            arm.explain("miss first", trace=20.0)

    asking = threading.Thread(target=ask)
    asking.start()
    wait_for(lambda: event.exists() and event.read_text() == "1\n", "it is followed")
    process.kill()
    process.wait()
    wait_for(lambda: not here.exists(), "the trace is removed")
    asking.join()
    nodes.agent_processes("arm0")
