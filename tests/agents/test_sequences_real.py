"""A program of jobs over a real agent: steps, an ELSE, a pause, an abort, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest
from watching import wait_for

from pbonet.master.subsystem import Phase, Sequencer, Subsystem

MODULE = """
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject, Signal, param

    class Of(Params):
        finish: A[int, param("none", "cycle of its signal FINISH")] = 0
        fail: A[int, param("none", "cycle in which it fails")] = 0

    class Count(PortBasedObject[Of]):
        '''Count its cycles.'''

        y: A[float, OutVar("Y", "1", "none", "cycles since on")]

        def on(self) -> None:
            self.y = 0.0

        def cycle(self, dt: float) -> None:
            self.y += 1.0
            if self.y == self.params.finish:
                self.task.signal(Signal.FINISH)
            if self.y == self.params.fail:
                raise ValueError("it broke")
"""
RMOD = (
    "MODULE count\nDESC a test\nINCONST none\nOUTCONST none\nINVAR none\nOUTVAR Y\n"
    "TASKTYPE periodic\nFREQ 200\nLOCAL\n{}\nEOF\n"
)
TASKS = {"quick": "FINISH 20", "broken": "FAIL 10", "long": "", "rest": ""}
SEQUENCE = """
SEQUENCE test
DESC a test
SBS c.sbs
SAFE rest UNTIL (Y > 10) WITHIN 60
WITHIN 60
STEP quick UNTIL FINISH
STEP broken UNTIL FINISH ELSE care
FAIL it is not broken
STEP care: quick UNTIL (Y > 5)
{}
EOF
"""


@pytest.fixture
def folder(nodes, tmp_path):
    nodes.write_module("count", MODULE)
    folder = tmp_path / "shop"
    folder.mkdir()
    (folder / "c.svar").write_text(
        "NAME Y\nTYPE double\nDESC y\nUNITS none\nNELEM 1\nEOF\n"
    )
    (folder / "c.sbs").write_text("SUBSYSTEM shop\nSVARFILE c.svar\nRTPU arm0\nEOF\n")
    for name, local in TASKS.items():
        (folder / f"{name}.rmod").write_text(RMOD.format(local))
        job = f"JOB {name}\nDESC\nSBS c.sbs\nTASK {name}\nEOF\n"
        (folder / f"{name}.job").write_text(job)
    (folder / "test.seq").write_text(SEQUENCE.format("STEP long UNTIL FINISH"))
    (folder / "ends.seq").write_text(SEQUENCE.format("DONE"))
    return folder


def test_steps_follow_each_other_and_an_abort_leads_to_the_safe_job(nodes, folder):
    nodes.agent_processes("arm0")
    arguments = {"domain": nodes.domain, "libraries": [str(nodes.library)]}
    with Subsystem(folder / "test.seq", **arguments) as shop:
        sequencer = Sequencer(shop)
        sequencer.pause()
        thread = threading.Thread(target=sequencer.run)
        thread.start()
        try:
            wait_for(lambda: sequencer.state.phase is Phase.PAUSED, "the pause")
            assert shop.status() == []
            sequencer.resume()
            wait_for(
                lambda: sequencer.state.waiting and sequencer.state.step == "long",
                "the last step",
            )
        finally:
            sequencer.abort("enough")
            thread.join()
        state = sequencer.state
        assert (state.phase, state.text) == (Phase.ABORTED, "enough")
        assert state.entered == ("quick", "broken", "care", "long", "rest")
        assert "the task broken sent ERROR" in state.errors[0]
        assert {one.task: one.state for one in shop.status()} == {"rest": "ON"}
        told = [one.text for one in shop.events() if one.code == "STEP"]
    assert [text.partition(": ")[2] for text in told] == [
        "test: STEP quick UNTIL FINISH",
        "test: STEP broken UNTIL FINISH ELSE care",
        "test: STEP care: quick UNTIL (Y > 5)",
        "test: STEP long UNTIL FINISH",
        "test: SAFE rest UNTIL (Y > 10) WITHIN 60.0",
    ]


def test_an_interrupt_of_run_leads_to_the_safe_job_before_the_end(
    nodes, folder, tmp_path
):
    """Without an interrupt it runs to its end, and its status is 0."""
    words = [sys.executable, "-m", "pbonet.cli", "run", "--domain", nodes.domain]
    words += ["--library", str(nodes.library), "--runs", str(tmp_path / "runs")]
    done = subprocess.run(
        [*words, str(folder / "ends.seq")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "step 3, care: job quick is ON" in done.stdout
    assert "sequence test ended" in done.stdout
    with subprocess.Popen(
        [*words, str(folder / "test.seq")],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as run:
        assert run.stdout is not None
        lines: list[str] = []
        for line in run.stdout:
            lines.append(line)
            if "job long is ON" in line:
                run.send_signal(signal.SIGINT)
    out = "".join(lines)
    assert run.returncode == 1, out
    assert "job rest is ON (the safe job)" in out
    assert "aborted: interrupted" in out
