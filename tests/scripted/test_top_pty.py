"""`pbonet top` on a pseudo-terminal, and its rows as data; agents are scripted."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pbonet.master.subsystem.subsystem import Subsystem

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0
_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@pytest.fixture
def running(world, agents, puma):
    agents("arm0", "arm1")
    with Subsystem(puma, domain=world.domain) as arm:
        arm.start("puma")
        arm.detach()
    return ["top", str(puma.with_suffix(".job")), "--domain", world.domain]


class Terminal:
    """A terminal with a program, whose keys are typed here."""

    def __init__(self, words):
        import fcntl
        import termios

        self.end, other = pty.openpty()
        fcntl.ioctl(other, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 160, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "pbonet.cli", *words],
            stdin=other,
            stdout=other,
            stderr=other,
            cwd=ROOT,
            env=os.environ | {"TERM": "xterm-256color", "COLUMNS": "160"},
            start_new_session=True,
        )
        os.close(other)
        self.text = ""

    def wait(self, *parts):
        """Wait until all parts are shown, after what was waited for before."""
        deadline = time.monotonic() + PATIENCE
        while not all(part in _CODES.sub("", self.text) for part in parts):
            assert time.monotonic() < deadline, (parts, self.text[-3000:])
            ready, _, _ = select.select([self.end], [], [], 0.2)
            if ready:
                self.text += os.read(self.end, 65536).decode("utf-8", "replace")
        self.text = ""

    def type(self, keys):
        self.text = ""
        os.write(self.end, keys.encode())

    def ended(self):
        deadline = time.monotonic() + PATIENCE
        while self.process.poll() is None and time.monotonic() < deadline:
            ready, _, _ = select.select([self.end], [], [], 0.05)
            if ready:
                try:
                    self.text += os.read(self.end, 65536).decode("utf-8", "replace")
                except OSError:
                    break
        return self.process.wait(PATIENCE)


@pytest.fixture
def terminal(running):
    shown = Terminal([*running, "--every", "0.2"])
    yield shown
    if shown.process.poll() is None:
        shown.process.kill()
        shown.process.wait()
    os.close(shown.end)


def test_keys_select_explain_and_filter(terminal, agents):
    terminal.wait("puma_pidg", "jttrace", "q quit")
    agents["arm1"].tasks["jttrace"].state = "ERROR"
    agents["arm1"].tasks["jttrace"].error = "cycle failed: no path"
    terminal.type("/jttrace\r")
    terminal.wait("filter: jttrace", "ERROR")
    terminal.type("\r")
    terminal.wait("task jttrace on arm1 is ERROR", "because cycle failed: no path")
    terminal.type("q")
    terminal.wait("filter: jttrace")
    terminal.type("\t")
    terminal.wait("RTPUs")
    terminal.type("q")
    assert terminal.ended() == 0
    assert "Traceback" not in terminal.text


def test_a_machine_that_goes_away_has_a_row_and_keys_work(terminal, agents):
    terminal.wait("puma_pidg")
    agents["arm1"].close()
    terminal.type("\t")
    terminal.wait("arm1", "away")
    terminal.type("\x03")
    assert terminal.ended() == 0


def test_elsewhere_it_is_data(running, agents, call):
    status, out, _ = call(*running, "--json", "--count", "1")
    assert status == 0
    data = json.loads(out)
    assert {one["task"] for one in data["tasks"]} >= {"puma_pidg", "jttrace"}
    assert {one["rtpu"]: one["state"] for one in data["RTPUs"]} == {
        "arm0": "answers",
        "arm1": "answers",
    }
    asked = [type(one).__struct_config__.tag for one in agents["arm0"].requests[-3:]]
    assert sorted(asked) == ["display", "hello", "status"], "each once a reading"


def test_elsewhere_it_is_a_table(running, call):
    status, out, _ = call(*running, "--count", "1", "--sort", "task")
    assert status == 0
    names = [line.split()[0] for line in out.splitlines()]
    assert names[:2] == ["task", "grav_comp"]


def test_all_machines_are_away(running, agents, call):
    for one in agents.values():
        one.close()
    status, out, _ = call(*running, "--json", "--count", "1")
    assert status == 0
    data = json.loads(out)
    assert set(data["silent"]) == {"arm0", "arm1"}
    assert {one["state"] for one in data["RTPUs"]} == {"away"}
