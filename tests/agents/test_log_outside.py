"""What modules hear from outside is on record: they are verified with nothing there.

Links, serial lines, queues and semaphores, drivers of one's own; and what no log can
have is said.
"""

from __future__ import annotations

import os
import tty

import pytest
from adding_module import ADDS
from log_of_real_tasks import begin, finish, record
from nodekit import rmod
from watching import wait_for

from pbonet import xm
from pbonet.log import Step
from pbonet.log.cycle_columns import head
from pbonet.testing import rerun, verify

LINK = """MODULE {module}
DESC one end of a link
SVARALIAS Z={variable}
INCONST none
OUTCONST none
INVAR {invar}
OUTVAR {outvar}
TASKTYPE periodic
FREQ {freq}
LOCAL
LINK {link}
EOF
"""
HEAD = """
import os
import socket
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param, xm
from pbonet.errors import DeviceError
from pbonet.io import Outside, SerialLine


class Where(Params):
    path: A[str, param("none", "where it is")] = ""


class Hears(PortBasedObject[Where]):
    y: A[Vector, OutVar("Y", "2", "none", "what was heard")]
"""
SERIAL = (
    HEAD
    + """
    def init(self) -> None:
        self.line = SerialLine(self.params.path)
        self.next = 0

    def cycle(self, dt: float) -> None:
        try:
            if not self.line.is_open and self.task.now >= self.next:
                self.line.open()
                self.line.write_nowait(b"hello")
            for byte in self.line.read_available():
                self.y[0] = (self.y[0] * 31.0 + byte) % 1e6
        except DeviceError as error:
            self.next = self.task.now + 20_000_000
            self.y[1] += 1.0
            self.task.warn(str(error))

    def kill(self) -> None:
        self.line.close()
"""
)
SERVER = (
    HEAD
    + """
    def init(self) -> None:
        self.queue = xm.queue("numbers", policy=xm.Policy.HPF)
        self.count = xm.semaphore("count", initial=5)
        self.y[:] = 0.0

    def sync(self) -> None:
        self.message = self.queue.receive()

    def cycle(self, dt: float) -> None:
        self.y[0] += float(self.message) + 0.125 * self.queue.last_priority
        if self.count.try_p():
            self.y[1] += 1.0 + self.count.value

    def kill(self) -> None:
        self.queue.destroy()
        self.count.destroy()
"""
)
LIMITED = SERVER.replace("receive()", "receive(self.task.now + 5_000_000)").replace(
    "float(self.message)", "float(self.message or 0)"
)
DRIVER = (
    HEAD
    + """
    def init(self) -> None:
        self.outside = Outside("a pipe")
        how = os.O_RDONLY | os.O_NONBLOCK
        self.fd = self.outside.ask(os.open, self.params.path, how)

    def cycle(self, dt: float) -> None:
        try:
            data = self.outside.ask(os.read, self.fd, 64, default=b"")
        except BlockingIOError:
            data = b""
        self.y[0] += sum(data)
        self.y[1] += self.task.crit

    def kill(self) -> None:
        self.outside.ask(os.close, self.fd)
"""
)
SOCKET = (
    HEAD
    + """
    def init(self) -> None:
        self.sock = socket.socket()

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
"""
)
SEGMENT = SOCKET.replace("socket.socket()", 'xm.segment("map", 64)')
PIPE = SOCKET.replace("socket.socket()", "os.open(self.params.path, os.O_RDWR)")


@pytest.fixture
def line(nodes):
    nodes.write_module("hears", HEAD)
    nodes.agent_process("arm0")
    return nodes.master("arm0", "arm")


def run(line, nodes, code, during, *, tasktype="periodic", **local):
    """Record a task that hears something, doing `during` meanwhile; return the run."""
    nodes.write_module("hears", code)
    path = record(line)
    text = rmod("hears", "Y2", local=local).replace("periodic", tasktype)
    line.spawn("hears", "hears", text=text)
    line.on("hears")
    during()
    line.off("hears")
    line.kill("hears")
    return finish(line, path)


def identical(log, task, least=1):
    """Assert that a task gives the same again, alone and with all others."""
    (verdict,) = verify(log, [task])
    assert verdict.good, str(verdict)
    assert verdict.cycles >= least
    assert rerun(log, [task]).good
    return verdict


def heard(log, task):
    """Return how many bytes the task's cycles heard in all."""
    return sum(
        len(life.schema.rest(one)[2])
        for life in log.lives(task)
        for one in life.commits
        if head(one)["kind"] == Step.CYCLE
    )


def test_what_came_over_a_link(nodes):
    nodes.write_module("adds", ADDS)
    nodes.agent_process("arm0")
    line = nodes.master("arm0", "arm")
    path = begin(line)
    send = LINK.format(
        module="tbuf_send",
        variable="Y0",
        invar="Z",
        outvar="none",
        freq=100,
        link="s",
    )
    get = LINK.format(
        module="tbuf_receive",
        variable="Y2",
        invar="none",
        outvar="Z",
        freq=300,
        link="arm:s",
    )
    line.spawn("send", "tbuf_send", text=send)
    line.spawn("get", "tbuf_receive", text=get)
    line.on("send")
    line.on("get")
    line.wait_cycles("get", 100)
    seen = set()

    def taken():
        seen.add(line.value("Y2").values[0])
        return len(seen) > 11

    wait_for(taken, "what was sent")
    for task in ("get", "send", "b", "a"):
        line.off(task)
        line.kill(task)
    log = finish(line, path)
    values = log.arrays("get")["Y2"]
    assert len({*values[:, 0].tolist()}) > 10, "it has received"
    assert heard(log, "get") > 10 * 48
    assert heard(log, "a") == 0, "who hears nothing pays nothing"
    assert all(one.good for one in verify(log)), "\n".join(map(str, verify(log)))
    assert rerun(log).good


def test_what_a_serial_line_gave_and_that_it_was_lost(line, nodes, tmp_path):
    master, slave = os.openpty()
    tty.setraw(slave)
    name = tmp_path / "line"  # the terminal's own is another test's next
    name.symlink_to(os.ttyname(slave))

    def lose_it():
        assert os.read(master, 5) == b"hello", "it is open"
        os.write(master, b"abc")
        wait_for(lambda: line.value("Y2").values[0] != 0.0, "the bytes")
        name.unlink()
        os.close(slave)
        os.close(master)
        wait_for(lambda: line.value("Y2").values[1] >= 2.0, "two attempts in vain")

    log = run(line, nodes, SERIAL, lose_it, path=str(name))
    identical(log, "hears")
    # Other code is still found out, by what it makes of the recorded bytes.
    nodes.write_module("hears", SERIAL.replace("31.0", "37.0"))
    (other,) = verify(log, ["hears"])
    assert other.divergence is not None
    assert other.divergence.variable == "Y2"


def test_what_a_server_received_and_the_values_of_a_semaphore(line, nodes):
    def send():
        xm.live_on("arm0", domain=nodes.domain)
        queue = xm.queue("arm0:numbers", policy=xm.Policy.HPF)
        try:
            for n in range(1, 9):
                queue.send(str(n).encode(), priority=n % 3)
                wait_for(
                    lambda n=n: line.value("Y2").values[0] >= n * (n + 1) / 2,
                    "what was sent",
                )
                if n == 4:
                    line.off("hears")
                    line.on("hears")
        finally:
            queue.close()
            xm.live_on("local")

    log = run(line, nodes, SERVER, send, tasktype="synchronous")
    verdict = identical(log, "hears", 8)
    assert verdict.recorded == 8
    assert log.arrays("hears")["Y2"][-1].tolist() == [36.0 + 0.125 * 9, 15.0]


def test_waits_in_vain(line, nodes):
    def send():
        xm.live_on("arm0", domain=nodes.domain)
        queue = xm.queue("arm0:numbers", policy=xm.Policy.HPF)
        try:
            for n in range(1, 4):
                line.wait_cycles("hears", 5)
                queue.send(str(n).encode(), priority=n)
        finally:
            queue.close()
            xm.live_on("local")
        wait_for(lambda: line.value("Y2").values[0] >= 6.0, "what was sent")
        line.wait_cycles("hears", 5)

    log = run(line, nodes, LIMITED, send, tasktype="synchronous")
    verdict = identical(log, "hears", 15)
    assert verdict.recorded == verdict.cycles


def test_a_driver_of_ones_own(line, nodes, tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR)

    def write():
        for n in range(3):
            os.write(fd, bytes([n + 1]) * 5)
            wait_for(lambda n=n: line.value("Y2").values[0] >= 5 * (n + 1), "bytes")

    log = run(line, nodes, DRIVER, write, path=path)
    os.close(fd)
    identical(log, "hears")


@pytest.mark.parametrize(
    ("code", "what"),
    [
        (SOCKET, "it opens a socket"),
        (SEGMENT, "it uses the shared memory segment map"),
        (PIPE, "it opens the device "),
    ],
)
def test_what_no_log_can_have_is_said(line, nodes, tmp_path, code, what):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    log = run(line, nodes, code, lambda: line.wait_cycles("hears", 3), path=path)
    (verdict,) = verify(log, ["hears"])
    assert verdict.cycles == 0
    assert verdict.divergence is None
    assert verdict.gaps[0].startswith(f"spawn after cycle 0: {what}")
    assert "in no log" in str(verdict)
