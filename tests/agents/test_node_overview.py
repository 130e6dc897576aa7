"""What an agent answers out of shared memory: its RTPU process is not woken for it."""

import os
import signal

import pytest
from long_limits import LIMIT
from watching import wait_for

from pbonet.errors import ClaimError, SvarError, SvarOwnerError, UnknownTaskError
from pbonet.xm.net import key_expressions, messages as m
from pbonet.xm.net.codec import Codec


@pytest.fixture
def held(nodes, arm):
    """An RTPU process that is stopped, with a task that is OFF."""
    arm.spawn("a", "counts")
    pid = nodes.stop_rtpu("arm0")
    yield arm
    os.kill(pid, signal.SIGCONT)


def test_looks_need_no_rtpu_process(held):
    status = held.rtpu_status()
    assert [(one.task, one.state) for one in status.tasks] == [("a", "OFF")]
    assert status.scheduler == "MUF"
    assert status.events[""]["CLAIM"] == 1
    (profile,) = held.ask(m.Profile(task="a"), list[m.TaskProfile])
    assert profile.status.task == "a"
    assert held.value("X").values == [1.0, 2.0]


def test_an_operator_writes_without_the_rtpu_process(held):
    got = held.ask(m.Write(name="X", values=[3.0, 4.0]), m.VarValue)
    assert (got.values, got.writer) == ([3.0, 4.0], None)
    assert held.value("X").values == [3.0, 4.0]


def test_who_may_not_write_is_refused_by_the_agent_too(nodes, held):
    request = m.Write(subsystem="arm", epoch=held.epoch - 1, name="X", values=[0, 0])
    with pytest.raises(ClaimError, match="another master controls subsystem arm now"):
        nodes.client().call("arm0", request, object)
    request = m.Write(subsystem="leg", epoch=held.epoch, name="X", values=[0, 0])
    with pytest.raises(ClaimError, match="has not claimed the RTPU"):
        nodes.client().call("arm0", request, object)
    assert held.value("X").values == [1.0, 2.0]


def test_a_repeated_write_is_carried_out_once(nodes, held):
    key = key_expressions.rtpu(nodes.domain, "arm0", "sbs")
    request = m.Write(
        subsystem="arm", epoch=held.epoch, id="1", client="c", name="X", values=[5, 6]
    )

    def ask():
        payload = Codec().pack(request)
        (reply,) = nodes.session.get(key, payload=payload, timeout=LIMIT)
        return reply.ok.payload.to_bytes()

    first = ask()
    held.ask(m.Write(name="X", values=[7.0, 8.0]))
    assert ask() == first, "the answer that was given before"
    assert held.value("X").values == [7.0, 8.0], "the repetition has written nothing"


def test_what_a_task_writes_an_operator_does_not(arm):
    arm.spawn("a", "counts")
    arm.on("a")
    error = arm.refused(SvarOwnerError, arm.ask, m.Write(name="Y0", values=[0, 0]))
    assert "a task writes it" in str(error)


def test_only_the_keeper_writes(nodes):
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", table=False)
    arm.open_table(keep=False)
    error = arm.refused(SvarError, arm.ask, m.Write(name="X", values=[0, 0]))
    assert "does not keep the table" in str(error)


def test_status_is_never_behind_an_answer(arm):
    """Each state is seen by whoever asks behind the answer that brought it about."""
    arm.spawn("a", "counts")
    for _ in range(20):
        arm.on("a")
        assert arm.status("a").state == "ON"
        arm.off("a")
        assert arm.status("a").state == "OFF"
    for round_ in range(5):
        arm.kill("a")
        assert arm.status() == {}
        error = arm.refused(UnknownTaskError, arm.status, "a")
        assert "has no task a here" in str(error)
        if round_ < 4:
            arm.spawn("a", "counts")
            assert arm.status("a").state == "OFF"


def test_a_status_of_many_tasks_is_whole(arm):
    names = [f"t{i}" for i in range(10)]  # more than are answered in zenoh's thread
    for i, name in enumerate(names):
        arm.spawn(name, "counts", out=f"Y{i % 8}")
    assert list(arm.status()) == names


def test_an_agent_that_takes_over_knows_all_at_once(nodes):
    process = nodes.agent_process("arm0", grace=30.0)
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts")
    nodes.forget_session()
    process.kill()
    process.wait()
    nodes.agent_process("arm0", grace=30.0)
    status = nodes.client().call("arm0", m.Status(), m.RtpuStatus)
    assert [(one.task, one.state) for one in status.tasks] == [("a", "OFF")]
    (value,) = nodes.client().call(
        "arm0", m.Display(subsystem="arm", names=["X"]), list[m.VarValue]
    )
    assert value.values == [1.0, 2.0]


def test_a_lost_rtpu_process_is_forgotten(nodes, arm):
    arm.spawn("a", "counts")
    old = nodes.state("arm0").pid
    os.kill(old, signal.SIGKILL)
    nodes.wait_restarted("arm0", old)
    wait_for(lambda: arm.rtpu_status().tasks == [], "no tasks")
