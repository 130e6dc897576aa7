"""An RTPU process that stands still for a while ends nobody's tasks."""

import os
import signal
import socket

from watching import wait_for


def test_a_stall_amid_a_message_ends_no_task(nodes):
    """More comes meanwhile than fits: a message is sent in parts, long apart."""
    nodes.agent("arm0", events={"parts": "cell/part"})
    arm = nodes.master("arm0", "arm")
    tid = arm.spawn("a", "counts").tid
    arm.on("a")
    rtpu = nodes.state("arm0").pid
    link = nodes.agents["arm0"]._link
    nodes.stop_rtpu("arm0")
    try:
        for _ in range(8):
            nodes.session.put("cell/part", bytes(100_000))
        wait_for(lambda: link._rest, "a message that was sent in part")
    finally:
        os.kill(rtpu, signal.SIGCONT)
    wait_for(lambda: not link._rest, "its rest")
    assert arm.wait_cycles("a", 5).tid == tid
    assert nodes.state("arm0").pid == rtpu
    assert arm.events("AGENT_GONE") == []


def test_a_link_that_breaks_ends_no_task(nodes):
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    tid = arm.spawn("a", "counts").tid
    arm.on("a")
    rtpu = nodes.state("arm0").pid
    link = nodes.agents["arm0"]._link
    broken = link._sock
    broken.shutdown(socket.SHUT_RDWR)
    wait_for(lambda: link._sock not in {None, broken}, "a new link")
    arm.wait_event("AGENT_BACK")
    assert arm.wait_cycles("a", 5).tid == tid
    assert nodes.state("arm0").pid == rtpu
    assert arm.off("a").state == "OFF"


def test_a_recorder_that_cannot_be_started_is_told(nodes, monkeypatch):
    """The agent goes on, and records when it is asked again."""
    from pbonet.node.agent import recorder_supervisor
    from pbonet.xm.net import messages as m

    def refused(*_, **__):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts")
    with monkeypatch.context() as patch:
        patch.setattr(recorder_supervisor.subprocess, "Popen", refused)
        arm.ask(m.Record(run="r", mode="outputs"), object)
        event = arm.wait_event("RECORDER_DIED")
        assert "could not be started" in event.text
    assert arm.on("a").state == "ON"
    assert arm.stop().off == ["a"]


def test_a_stopped_rtpu_process_is_continued_by_its_agent(nodes):
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    tid = arm.spawn("a", "counts").tid
    arm.on("a")
    rtpu = nodes.state("arm0").pid
    os.kill(rtpu, signal.SIGSTOP)
    told = arm.wait_event("RESUMED")
    assert f"the RTPU process (process {rtpu}) was stopped by a signal" in told.text
    assert arm.wait_cycles("a", arm.status("a").cycle + 5).tid == tid
    assert nodes.state("arm0").pid == rtpu
