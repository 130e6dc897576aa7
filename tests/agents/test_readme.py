"""What README.md shows is run as it stands there, line by line."""

from __future__ import annotations

import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from typed_terminal import PATIENCE, Desk, words_of
from watching import wait_for

from pbonet.config.library import Library
from pbonet.testing import Bench

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text()


def blocks(kind):
    """Return the blocks of the page that are marked so."""
    return re.findall(rf"^```{kind}\n(.*?)^```$", TEXT, re.DOTALL | re.MULTILINE)


MAKE, BY_HAND, RTPUS, STEPS, OWN = map(words_of, blocks("sh"))


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
    named = re.findall(r"(?:^|`)make ([a-z-]+)", TEXT, re.MULTILINE)
    assert MAKE == [["make", "demo"]]
    for target in named:
        assert re.search(rf"^{target}:.*## ", makefile, re.MULTILINE), target
    assert BY_HAND[:2] == [[".", ".venv/bin/activate"], ["cd", "examples/puma"]]
    assert "VENV := .venv\n" in makefile
    for page in re.findall(r"\]\((docs/[^)#]+)\)", TEXT):
        assert (ROOT / page).exists(), page


def test_the_class_holds_the_axes_of_the_example(tmp_path):
    enter, *commands = OWN
    folder = tmp_path / "example"
    shutil.copytree(ROOT / enter[1], folder)
    (folder / "joint_pd.py").write_text(blocks("python")[0])
    (tmp_path / "desk").mkdir()
    own = Desk(tmp_path / "desk", folder)
    try:
        out = [own.call(words) for words in commands]
    finally:
        own.close()
    assert out[0].split() == ["hold.svar", "hold.sbs", "hold.job"]
    assert re.search(r"^joint_pd +core0 +ON +1000 +0 +0 ", out[1], re.MULTILINE), out


@pytest.fixture
def desk(tmp_path_factory):
    desk = Desk(tmp_path_factory.mktemp("desk"), ROOT / "examples" / "puma")
    yield desk
    desk.close()


def test_a_job_is_checked_and_run_by_hand(desk, shared_memory):
    check, graph, run = BY_HAND[2:]
    *_, verdict = desk.call(check).splitlines()
    assert verdict == "puma.job: job teleop of 4 tasks: legal"
    assert "<- T_GRAV          [6] N*m      grav_comp\n" in desk.call(graph)
    assert run[:2] == ["pbonet", "run"]
    out = desk.call(run, "--seconds", "0.5")
    for task in ("puma_pidg", "grav_comp", "qrdiff", "jttrace"):
        assert re.search(rf"^{task} +arm[01] +ON ", out, re.MULTILINE), out
    assert desk.processes() == []
    assert list(shared_memory.iterdir()) == []


@pytest.mark.timeout(600)
def test_a_job_is_assembled_piece_by_piece(desk, shared_memory):
    for words in RTPUS:
        assert words[-1] == "&"
        agent = desk.begin(words[:-1])
        assert f"{words[3]}: ready on core " in agent.stdout.readline()
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
