"""Ending a simulation early: in order at the first signal, at once at the second."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pbonet.log import Log, last_run

PUMA = Path(__file__).parents[3] / "examples" / "puma"
RUN = """
import signal
import sys
from pbonet.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # it may have been ignored
main(sys.argv[1:])
"""
HANGS = '''
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject


class Hangs(PortBasedObject):
    """Count to ten, then never come back."""

    y: A[float, OutVar("Y", "1", "none", "count")]

    def cycle(self, dt):
        self.y += 1.0
        if self.y == 10.0:
            print("hanging", flush=True)
            while True:
                pass
'''


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a simulation that has no end but with the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*words: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", RUN, "run", "--sim", "--seconds", "1e6"]
        process = subprocess.Popen(
            [*command, *map(str, words)],
            cwd=PUMA.parents[1],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def wait_for_line(process: subprocess.Popen[str], text: str) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return
    pytest.fail(f"no line says {text}")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_ends_it_in_order_and_sums_up(start, tmp_path, number) -> None:
    process = start(PUMA / "puma.job", "--runs", tmp_path)
    wait_for_line(process, "is ON in virtual time: puma_pidg, grav_comp")
    process.send_signal(number)
    out, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    assert "interrupted\n" in out
    row = next(line.split() for line in out.splitlines() if line[:9] == "puma_pidg")
    assert row[1:3] == ["arm0", "ON"]
    assert row[7:14] == ["-"] * 7, "CPU time, jitter and transfers are not simulated"
    assert Log(last_run(tmp_path)).variables("grav_comp") == ["T_GRAV"]


def test_second_signal_ends_a_module_that_hangs(start, tmp_path) -> None:
    (tmp_path / "hangs.py").write_text(HANGS)
    (tmp_path / "hangs.rmod").write_text(
        "MODULE hangs\nDESC d\nINCONST none\nOUTCONST none\nINVAR none\nOUTVAR Y\n"
        "TASKTYPE periodic\nFREQ 100\nEOF\n"
    )
    (tmp_path / "a.svar").write_text(
        "NAME Y\nTYPE double\nDESC d\nUNITS none\nNELEM 1\nEOF\n"
    )
    (tmp_path / "a.sbs").write_text("SUBSYSTEM a\nSVARFILE a.svar\nRTPU a0\nEOF\n")
    (tmp_path / "a.job").write_text("JOB a\nDESC d\nSBS a.sbs\nTASK hangs\nEOF\n")
    process = start(tmp_path / "a.job", "--library", tmp_path)
    wait_for_line(process, "hanging")
    process.send_signal(signal.SIGINT)
    while process.poll() is None:  # until the first one was taken the second is none
        process.send_signal(signal.SIGINT)
        try:
            process.wait(2.0)  # a third one may end it in another way
        except subprocess.TimeoutExpired:
            continue
    assert process.returncode in {130, -signal.SIGINT}  # the latter by a third one
