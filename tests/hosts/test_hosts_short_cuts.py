"""Interruptions of a cable that a link outlives."""

from __future__ import annotations

import subprocess
import sys

import pytest
import zenoh
from hostfleet import Desk
from hostkit import OWN_PORT, Lab
from long_limits import LIMIT
from nodekit import AGENT
from watching import wait_for

from pbonet.testing.lan import Lan
from pbonet.xm.net import key_expressions, messages as m

KEEPS = AGENT.replace("SILENT_MS = session.LEASE_MS", "SILENT_MS = 1000")
"""An agent that keeps a silent link for longer than it believes in the other one."""
TRIES = 8
"""Retransmissions of TCP; with doubling pauses they take 19 s."""
LONG = 12.0
SENDER = """
import socket, sys, time
from pbonet.node.agent.retransmission import Retransmission

one = socket.create_connection((sys.argv[1], 7000))
one.sendall(b"x")
one.recv(1)
care = Retransmission()
care.find()
print("linked", flush=True)
sys.stdin.readline()
one.sendall(b"y" * 100)
begun = time.monotonic()
again = 0
while again < int(sys.argv[2]):
    time.sleep(care.tend())
    data = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 8)
    assert data[0] == 1, "the connection has ended"
    again = data[2]
print(time.monotonic() - begun, flush=True)
"""
LISTENER = """
import socket
room = socket.create_server(("", 7000))
print("listens", flush=True)
while True:
    one, _ = room.accept()
    one.sendall(one.recv(1))
"""


def test_lost_data_are_sent_again_soon(lan, popen) -> None:
    listener = popen(lan["b"].command(sys.executable, "-c", LISTENER))
    assert listener.stdout.readline() == "listens\n"
    where = lan["b"].address("a"), str(TRIES)

    def soon():
        """A machine that stands still at a bad moment ends the connection."""
        lan.heal("a", "b")
        sender = popen(lan["a"].command(sys.executable, "-c", SENDER, *where))
        assert sender.stdout.readline() == "linked\n"
        lan.mute("a", "b")
        sender.stdin.write("\n")
        sender.stdin.flush()
        took = sender.stdout.readline()
        return bool(took) and float(took) < LONG

    try:
        wait_for(soon, "retransmissions without long pauses")
    finally:
        lan.heal("a", "b")


@pytest.mark.parametrize("how", [Lan.cut, Lan.mute])
def test_a_machine_is_out_of_sight_while_its_link_is_kept(lan, how) -> None:
    lan.heal_all()
    lab = Lab(lan, OWN_PORT, lease_ms=round(LIMIT * 1e3))
    gone: list[str] = []

    def seen(sample):
        if sample.kind == zenoh.SampleKind.DELETE:
            gone.append(str(sample.key_expr))

    try:
        lab.start("arm0", "a", code=KEEPS)
        lab.start("arm1", "b", connect=[lab.endpoint("a", "b")], code=KEEPS)
        lab.wait_all()
        desk = Desk(lab, "cell", ("arm0", "arm1"), host="b")
        desk.spawn("arm0", "src", "counts", out="Z0")
        desk.on("arm0", "src")
        wait_for(lambda: desk.value("arm1", "Z0").writer == "src@host-a", "news")
        tokens = (
            lab
            .session("b")
            .liveliness()
            .declare_subscriber(key_expressions.all_rtpus(lab.domain, "alive"), seen)
        )
        how(lan, "a", "b")
        cause = "host host-a is unreachable"
        wait_for(lambda: cause in desk.illegal("arm1"), "the flag")
        lan.heal("a", "b")
        wait_for(lambda: not desk.illegal("arm1"), "healing")
        first = desk.value("arm1", "Z0").cycle
        wait_for(lambda: desk.value("arm1", "Z0").cycle > first, "news of src")
        assert not gone, "the link was given up"
        tokens.undeclare()
        desk.close()
    finally:
        lan.heal_all()
        lab.close()


def test_few_old_values_are_written_after_an_interruption(lan) -> None:
    """Else they would be written one after the other, before the first new one."""
    lan.heal_all()
    lab = Lab(lan, OWN_PORT, lease_ms=round(LIMIT * 1e3))

    def skipped():
        (news,) = desk.look("arm1", m.Links(), m.LinkReport).tables
        return news.gaps

    try:
        lab.start("arm0", "a")
        lab.start("arm1", "b", connect=[lab.endpoint("a", "b")])
        lab.wait_all()
        desk = Desk(lab, "cell", ("arm0", "arm1"), host="b")
        desk.spawn("arm0", "src", "counts", out="Z0", freq=500.0)
        desk.on("arm0", "src")
        wait_for(lambda: desk.value("arm1", "Z0").cycle > 100, "news")
        before = skipped()
        lan.mute("a", "b")
        begin = desk.value("arm0", "Z0").cycle
        wait_for(lambda: desk.value("arm0", "Z0").cycle > begin + 400, "many cycles")
        end = desk.value("arm0", "Z0").cycle
        lan.heal("a", "b")
        wait_for(lambda: desk.value("arm1", "Z0").cycle > end, "news of src")
        assert skipped() - before > (end - begin) / 2
        desk.close()
    finally:
        lan.heal_all()
        lab.close()


@pytest.fixture
def popen():
    """Start programs with pipes; they are killed at the end."""
    started: list[subprocess.Popen] = []

    def start(command):
        pipe = subprocess.PIPE
        made = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        started.append(made)
        return made

    yield start
    for one in started:
        one.kill()
        one.communicate(timeout=LIMIT)
