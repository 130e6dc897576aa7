"""What docs/first.md shows is done as it stands there, command by command."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typed_terminal import PATIENCE, ROOT, Desk, words_of

from pbonet.log import Log, last_run

TEXT = (ROOT / "docs" / "first.md").read_text()
WHOLE = re.DOTALL | re.MULTILINE
FILES = dict(re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)^```$", TEXT, WHOLE))
COMMANDS = {
    name: words_of(block)
    for name, block in re.findall(
        r"<!-- commands: (\w+) -->\n```sh\n(.*?)^```$", TEXT, WHOLE
    )
}


@pytest.fixture
def desk(tmp_path_factory):
    """A terminal in a folder with the files of the page."""
    folder = tmp_path_factory.mktemp("swing")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    desk = Desk(tmp_path_factory.mktemp("desk"), folder)
    yield desk
    desk.close()


def test_the_page_has_what_is_tested_here():
    assert list(COMMANDS) == ["begin", "run", "live", "change", "swap"]
    assert [Path(name).suffix for name in FILES] == [
        ".py",
        ".rmod",
        ".rmod",
        ".svar",
        ".sbs",
        ".job",
        ".py",
        ".rmod",
    ]


def test_it_runs_in_virtual_time_and_is_drawn(desk):
    check, run = COMMANDS["run"]
    *_, verdict = desk.call(check).splitlines()
    assert verdict == "swing.job: job swing of 3 tasks: legal"
    assert "10 s of virtual time are over" in desk.call(run)
    recording = Log(last_run(desk.env["PBONET_RUNS"]))
    time, angle = recording.series("Q_MEZ")
    _, reference = recording.series("Q_REF")
    assert len(angle) == 5000
    assert np.ptp(reference, axis=0) == pytest.approx([1.0, 1.0], abs=0.02)
    late = angle[time > 4.0]
    assert np.ptp(late, axis=0) == pytest.approx([1.0, 1.0], abs=0.15)
    subprocess.run(
        [sys.executable, "plot.py"],
        cwd=desk.cwd,
        env=desk.env | {"MPLBACKEND": "Agg"},
        check=True,
        timeout=PATIENCE,
    )
    assert (desk.cwd / "swing.png").stat().st_size > 0


@pytest.mark.timeout(600)
def test_it_changes_while_it_runs(desk, shared_memory):
    (words,) = COMMANDS["live"]
    run = desk.begin(words)
    for line in run.stdout:
        if "job swing is ON" in line:
            break
    display, kp, inertia = COMMANDS["change"]
    shown = desk.call(display)
    assert re.search(r"^Q_REF +wave .* rad ", shown, re.MULTILINE)
    assert re.search(r"^Q_MEZ +masses .* rad ", shown, re.MULTILINE)
    assert "200.0" in desk.call(kp)
    assert "1.0" in desk.call(inertia)
    swap, status, stop = COMMANDS["swap"]
    *steps, states = desk.call(swap).splitlines()
    assert steps[0].startswith("spawn soft on ")
    assert steps[1:3] == ["off joint_pid", "on soft"]
    assert states == "joint_pid OFF  soft ON"
    assert re.search(r"^joint_pid .* OFF ", desk.call(status), re.MULTILINE)
    assert "soft" in desk.call(stop)
    out, _ = run.communicate(timeout=PATIENCE)
    assert run.returncode == 0
    assert "job swing ended" in out
    assert desk.processes() == []
    assert list(shared_memory.iterdir()) == []
