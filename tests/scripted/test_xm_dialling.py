"""Two agents that name each other: one dials, in whatever order they come to decide."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

PROGRAM = """
import json, sys
from pbonet.xm.net import dialling, run_folder as rundir

dialling.ASK_TIME = 10.0  # who is there answers, however busy the machine
domain, name, listen, *connect = sys.argv[1:]
places = rundir.Places(domain, name)
lock = rundir.NameLock(places.lock, name)
open_session = dialling.Dialled._open

def step(done):
    print(json.dumps(done), flush=True)
    return sys.stdin.readline()

def held(self):
    dialling.Dialled._open = open_session
    step(self.dials)
    return self._open()

sys.stdin.readline()
dialling.Dialled._open = held
made = dialling.Dialled(places, listen=[listen], connect=connect)
step(made.dials)
made.settle()
step(made.dials)
made.session.close()
"""
"""Does one step of an agent's start for each line: ask, open, settle."""


SETTLE = 3
"""The number of the last step."""


class Starting:
    """An agent that starts as far as it is told."""

    def __init__(self, folder, name, listen, *connect):
        folder.mkdir(mode=0o700, exist_ok=True)
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "pairs", name, listen, *connect],
            env={**os.environ, "PBONET_RUN_DIR": str(folder)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def tell(self):
        """Have it do its next step."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def answer(self):
        """Return what it dials when the step is done."""
        return json.loads(self.process.stdout.readline())

    def end(self):
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def pair():
    """Returns agents a and b on one machine, or as if on two, and where they listen."""
    base = Path(tempfile.mkdtemp(prefix="pbonet-", dir="/tmp"))
    both = []

    def make(*, machines):
        at = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
        far = at if machines > 1 else []
        for i, name in enumerate("ab"):
            place = base / (name if machines > 1 else "one")
            both.append(Starting(place, name, at[i], *far[1 - i : 2 - i]))
        return at, both

    yield make
    for one in both:
        one.end()
    shutil.rmtree(base)


ORDERS = [
    "aaa bbb",
    "bbb aaa",
    "aab abb",
    "ab aabb",
    "ab abab",
    "ab abba",
    "ab baab",
    "ab baba",
    "ab bbaa",
    "bba baa",
]
"""Whose turn it is; each asks the other, opens its session, and settles."""


@pytest.mark.parametrize("order", ORDERS)
def test_one_of_two_dials(pair, order):
    at, both = pair(machines=2)
    turns = dict.fromkeys("ab", 0)
    for name in order.replace(" ", ""):
        one = both["ab".index(name)]
        one.tell()
        turns[name] += 1
        if turns[name] < SETTLE:
            one.answer()  # the last step may wait for the other one's
    assert [one.answer() for one in both] in ([[at[1]], []], [[], [at[0]]])


@pytest.mark.parametrize("machines", [1, 2])
def test_both_at_once(pair, machines):
    _, both = pair(machines=machines)
    for _ in range(SETTLE):
        for one in both:
            one.tell()
        dials = [one.answer() for one in both]
    assert sorted(map(len, dials)) == [0, 1]


def test_who_is_to_give_way_may_do_so_late(pair):
    """b hangs before it takes its own back; a waits for it no longer than a while."""
    at, (a, b) = pair(machines=2)
    for _ in range(SETTLE - 1):
        for one in (a, b):
            one.tell()
        dials = [one.answer() for one in (a, b)]
    assert dials == [[at[1]], [at[0]]]
    a.tell()
    assert a.answer() == [at[1]]
    b.tell()
    assert b.answer() == []
