"""`pbonet explain` about a log: what it reads from cycles, events and files."""

from __future__ import annotations

import random

import pytest
from made_logs import PLAIN, about, group, record, run
from msgspec import structs

from pbonet.errors import LogError
from pbonet.log import Attached, LogWriter
from pbonet.master import diagnosis
from pbonet.master.configuration import Place

PERIOD = 10_000_000
SBS = b"SUBSYSTEM arm\nSVARFILE a.svar\nRTPU arm0\nEOF\n"
SVAR = b"NAME Y\nTYPE double\nDESC place\nUNITS m\nNELEM 6\nEOF\n"
RMOD = """MODULE m
DESC d
INCONST none
OUTCONST none
INVAR none
OUTVAR Y
TASKTYPE periodic
FREQ 100
EOF
"""


def event(code, text, at, task="", state=""):
    return {
        "n": 1,
        "time": at,
        "wall": at * 1e-9,
        "severity": 30,
        "code": code,
        "rtpu": "arm0",
        "subsystem": "arm",
        "task": task,
        "state": state,
        "text": text,
    }


def cycle(number, at, cpu=1_000_000, seed=1):
    data, _ = group(PLAIN, random.Random(seed))
    return record(
        data,
        cycle=number,
        release_ns=at,
        start_ns=at,
        end_ns=at + cpu,
        cpu_ns=cpu,
    )


@pytest.fixture
def log(tmp_path):
    """Give a log: cycle 10 of the task pid takes too long, and three are missed."""
    path = tmp_path / "run.mcap"
    files = [Attached("a.sbs", SBS), Attached("a.svar", SVAR)]
    writer = LogWriter(path, run(), files)
    number = writer.add_task(structs.replace(about("pid", PLAIN), rmod=RMOD))
    for n in range(1, 31):
        missed = 3 if n > 10 else 0
        cpu = 35_000_000 if n == 10 else 1_000_000
        writer.add(number, cycle(n, (n + missed) * PERIOD, cpu))
    for one in (
        event("STATE", "on: ON", PERIOD, "pid", "ON"),
        event("ILLEGAL", "the grip is open (arm0/pid)", 20 * PERIOD),
        event("METHOD", "pid.cycle: no grip", 34 * PERIOD, "pid", "ERROR"),
        event("STATE", "off: OFF", 35 * PERIOD, "other", "OFF"),
        event("ILLEGAL", "equation 2: no task writes Y for pid (master)", 36 * PERIOD),
        event("STOPPED", "all", 37 * PERIOD),
    ):
        writer.add_event(one)
    writer.close()

    def answer(*words):
        return diagnosis.answer(path, words, Place())

    return answer


def test_missed_releases_have_the_cycle_that_took_too_long(log):
    text = diagnosis.text(log("miss", "pid"))
    assert text.startswith("pid has missed 3 cycles in 1 places\n")
    assert "because 3 releases before cycle 11 [log]" in text
    assert "the cycle before took 35 ms of CPU time, and its period is 10 ms" in text
    assert "pid has missed 0 releases before cycle 25" in diagnosis.text(
        log("miss", "pid", "25")
    )


def test_the_flag_has_the_causes_from_before_the_end(log):
    text = diagnosis.text(log())
    assert "because the grip is open (arm0/pid), on arm0" in text
    assert "equation 2" not in text, "everything was being turned off"


def test_a_task_is_explained_as_it_was_before_the_end(log):
    text = diagnosis.text(log("pid"))
    assert text.startswith("task pid on arm0 is ERROR")
    assert "METHOD of arm0/pid" in text


def test_a_variable_has_its_writer(log):
    found = log("Y")
    assert found.kind == "variable"
    assert found.what.startswith("Y is 0.")


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"x" * 99)
    with pytest.raises(LogError):
        diagnosis.answer(tmp_path / "run.mcap", (), Place())
