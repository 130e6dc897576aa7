"""Tasks that are timed from outside: they wait, and hear all the same."""

import os
import signal
from pathlib import Path

import pytest
from nodekit import alive, rmod, wait_gone
from watching import wait_for

from pbonet.node.task.task_channel import INTERRUPT, ORPHAN_SIGNAL
from pbonet.xm.net import messages as m


@pytest.fixture
def fifo(tmp_path):
    path = tmp_path / "events"
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR)
    yield path, lambda *events: os.write(fd, bytes(events))
    os.close(fd)


@pytest.fixture
def waiting(arm, fifo):
    """A synchronous task that is ON and waits."""
    path, _ = fifo
    text = rmod("waits", local={"FIFO": path}).replace("periodic", "synchronous")
    assert arm.spawn("w", "waits", text=text).S == "Y"
    assert arm.on("w").state == "ON"
    return arm


def test_each_event_is_a_cycle(waiting, fifo):
    _, send = fifo
    for count, byte in enumerate((7, 8, 9), 1):
        send(byte)
        wait_for(lambda: waiting.value("Y0").values == [count, byte], "its cycle")  # noqa: B023
    status = waiting.status("w")
    assert (status.cycle, status.miss) == (3, 0)


def test_commands_end_the_wait(waiting, fifo):
    _, send = fifo
    assert waiting.ask(m.Get(task="w"), list[m.ParamValue])[0].name == "fifo"
    assert waiting.off("w").state == "OFF"
    assert waiting.value("Y0").values == [0.0, -1.0]
    assert waiting.on("w").state == "ON"
    send(5)
    wait_for(lambda: waiting.value("Y0").values == [1.0, 5.0], "its cycle")
    assert waiting.status("w").miss == 0
    tid = waiting.status("w").tid
    assert waiting.kill("w").state == "NOT-CREATED"
    assert not alive(tid)


@pytest.mark.parametrize(
    ("byte", "said"),
    [(255, "the worst of all bytes"), (254, "the second worst of all bytes")],
)
def test_error_in_sync(waiting, fifo, byte, said):
    _, send = fifo
    send(byte)
    event = waiting.wait_event("METHOD", "w")
    assert "w.sync" in event.text
    assert said in event.text
    assert waiting.status("w").state == "ERROR"


def test_stop_ends_the_wait(waiting):
    stopped = waiting.stop()
    assert (stopped.off, stopped.killed) == (["w"], [])


@pytest.mark.parametrize("victim", ["rtpu", "forks", "task"])
def test_end_of_others_ends_the_wait(waiting, nodes, victim):
    tid = waiting.status("w").tid
    pids = {
        "rtpu": nodes.state("arm0").pid,
        "forks": nodes.fork_server("arm0"),
        "task": tid,
    }
    which = signal.SIGTERM if victim == "task" else signal.SIGKILL
    os.kill(pids[victim], which)
    wait_gone([tid])
    if victim != "rtpu":
        assert waiting.value("Y0").values == [0.0, -1.0]  # `off` has run


def pending(tid):
    """Return the signals that wait for a process to take them."""
    text = Path(f"/proc/{tid}/status").read_text(encoding="ascii")
    lines = dict(line.split(":", 1) for line in text.splitlines())
    bits = int(lines["ShdPnd"], 16) | int(lines["SigPnd"], 16)
    return {signal.Signals(n) for n in range(1, 32) if bits >> (n - 1) & 1}


def test_both_words_of_a_lost_fork_server_may_come_at_once(waiting, nodes):
    """The kernel's and the RTPU process's: one alone would begin the wait again."""
    tid = waiting.status("w").tid
    os.kill(tid, signal.SIGSTOP)
    os.kill(nodes.fork_server("arm0"), signal.SIGKILL)
    wait_for(lambda: {ORPHAN_SIGNAL, INTERRUPT} <= pending(tid), "both signals")
    os.kill(tid, signal.SIGCONT)
    wait_gone([tid])
    assert waiting.value("Y0").values == [0.0, -1.0]  # `off` has run
