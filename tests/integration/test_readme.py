"""What README.md shows is run as it stands there, line by line."""

from __future__ import annotations

import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from watching import clean_folder, processes_of, wait_for

from pbonet.config.library import Library
from pbonet.testing import Bench

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text()
PATIENCE = 60.0
"""Seconds for one command on a machine that does much else."""


def blocks(kind):
    """Return the blocks of the page that are marked so."""
    return re.findall(rf"^```{kind}\n(.*?)^```$", TEXT, re.DOTALL | re.MULTILINE)


def words_of(block):
    """Return each line of a block as words, without its comment."""
    lines = (shlex.split(line, comments=True) for line in block.splitlines())
    return [words for words in lines if words]


MAKE, BY_HAND, RTPUS, STEPS = map(words_of, blocks("sh"))


def test_the_class_runs_and_computes_what_it_says(tmp_path):
    (text,) = blocks("python")
    (tmp_path / "joint_pd.py").write_text(text)
    module = Library([tmp_path]).load("joint_pd").cls
    bench = Bench(module, params={"kp": 10.0, "kd": 2.0}, ndof=2)
    bench.on()
    bench.inputs.q_ref = [1.0, -1.0]
    bench.inputs.q = [0.5, 0.0]
    bench.inputs.qd = [0.1, -0.2]
    bench.step(0.002)
    assert np.allclose(bench.outputs.tau, [10 * 0.5 - 0.2, -10 + 0.4])


def test_what_it_makes_and_enters_is_there():
    makefile = (ROOT / "Makefile").read_text()
    named = re.findall(r"`?make ([a-z]+)\b", TEXT)
    assert MAKE == [["make", "demo"]]
    for target in named:
        assert re.search(rf"^{target}:.*## ", makefile, re.MULTILINE), target
    assert BY_HAND[:2] == [[".", ".venv/bin/activate"], ["cd", "examples/puma"]]
    assert "VENV := .venv\n" in makefile
    for page in re.findall(r"\]\((docs/[^)#]+)\)", TEXT):
        assert (ROOT / page).exists(), page


class Desk:
    """A terminal in examples/puma, with a runtime folder of its own."""

    def __init__(self, folder):
        self.folder = folder
        self.started = []
        shim = folder / "bin" / "pbonet"
        shim.parent.mkdir()
        python = shlex.quote(sys.executable)
        shim.write_text(f'#!/bin/sh\nexec {python} -m pbonet.cli "$@"\n')
        shim.chmod(0o700)
        (folder / "run").mkdir(mode=0o700)
        self.env = os.environ | {
            "PATH": f"{shim.parent}:{os.environ.get('PATH', os.defpath)}",
            "PBONET_RUN_DIR": str(folder / "run"),
            "PYTHONPATH": str(ROOT),
            "XDG_STATE_HOME": str(folder),
            "COLUMNS": "120",
            "TERM": "xterm",
        }
        self.env.pop("PBONET_DOMAIN", None)

    def call(self, words, *more):
        """Run a command to its end; return what it printed."""
        done = subprocess.run(
            [*words, *more],
            cwd=ROOT / "examples" / "puma",
            env=self.env,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=PATIENCE,
            check=False,
        )
        assert done.returncode == 0, (words, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr
        return done.stdout

    def begin(self, words):
        """Start a command in the background."""
        process = subprocess.Popen(
            words,
            cwd=ROOT / "examples" / "puma",
            env=self.env,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.started.append(process)
        return process

    def prompt(self, words, typed):
        """Run a command on a terminal, type there, and return what was seen."""
        master, slave = pty.openpty()
        process = subprocess.Popen(
            words,
            cwd=ROOT / "examples" / "puma",
            env=self.env,
            stdin=slave,
            stdout=slave,
            stderr=slave,
        )
        self.started.append(process)
        os.close(slave)
        seen = bytearray()

        def look():
            try:
                while data := os.read(master, 4096):
                    seen.extend(data)
                    if b"\x1b[6n" in data:  # it asks where the cursor is
                        os.write(master, b"\x1b[1;1R")
            except OSError:
                return  # the terminal's other end is closed

        reader = threading.Thread(target=look, daemon=True)
        reader.start()
        for wanted, text in typed:
            wait_for(lambda wanted=wanted: wanted in seen, repr(wanted), PATIENCE)
            os.write(master, text)
        assert process.wait(PATIENCE) == 0, seen.decode(errors="replace")
        reader.join(PATIENCE)
        os.close(master)
        return seen.decode(errors="replace")

    def processes(self):
        """Return what runs in its runtime folder."""
        return processes_of("PBONET_RUN_DIR", str(self.folder / "run"))

    def close(self):
        """End what a failed test left, and see that nothing is left."""
        for process in self.started:
            if process.poll() is None:
                process.kill()
            process.communicate()
        clean_folder(self.folder / "run", "PBONET_RUN_DIR")


@pytest.fixture
def desk(tmp_path_factory):
    desk = Desk(tmp_path_factory.mktemp("desk"))
    yield desk
    desk.close()


@pytest.mark.timeout(240)
def test_a_job_is_checked_and_run_by_hand(desk, shared_memory):
    check, run = BY_HAND[2:]
    assert desk.call(check) == "puma.job: job teleop of 4 tasks: legal\n"
    assert run[:2] == ["pbonet", "run"]
    out = desk.call(run, "--seconds", "0.5")
    for task in ("puma_pidg", "grav_comp", "qrdiff", "jttrace"):
        assert re.search(rf"^{task} +arm[01] +ON ", out, re.MULTILINE), out
    assert desk.processes() == []
    assert list(shared_memory.iterdir()) == []


@pytest.mark.timeout(600)
def test_a_job_is_assembled_piece_by_piece(desk, shared_memory):
    core = str(max(os.sched_getaffinity(0)))
    for words in RTPUS:
        assert words[-3:] == ["--core", "1", "&"]
        agent = desk.begin([*words[:-2], core])
        assert f"{words[3]}: ready on core {core}" in agent.stdout.readline()
    *verbs, sbs, kill = STEPS
    out = {words[1]: desk.call(words) for words in verbs}
    assert list(out) == ["start", "status", "display", "set", "reconfig", "stop"]
    for task in ("puma_pidg", "grav_comp", "qrdiff", "jttrace"):
        assert f"{task} ON" in out["start"]
        assert re.search(rf"^{task} +arm[01] .* ON ", out["status"], re.MULTILINE)
        assert task in out["stop"]
    assert re.search(r"^Q_MEZ +puma_pidg .* rad ", out["display"], re.MULTILINE)
    gains = " ".join(next(words for words in verbs if words[1] == "set")[5:])
    assert gains in out["set"]
    assert "jttrace ON" in out["reconfig"]
    typed = [(b"SBS puma<", b"status\r"), (b"F12", b"quit\r")]
    assert "SBS puma<" in desk.prompt(sbs, typed)
    assert kill == ["kill", "%1", "%2"]
    for agent in desk.started[: len(RTPUS)]:
        agent.send_signal(signal.SIGTERM)
        assert agent.wait(PATIENCE) == 0
    wait_for(lambda: desk.processes() == [], "the end of all processes", PATIENCE)
    assert list(shared_memory.iterdir()) == []
