"""What a job and a command line say about recording, and what comes of both."""

from __future__ import annotations

from types import SimpleNamespace

import msgspec
import pytest

from pbonet.config import parse_job
from pbonet.errors import LogError, Severity
from pbonet.log import Log, TaskAbout
from pbonet.master.subsystem.recording_control import RecordingControl
from pbonet.node.recorder.recorder_process import Recorder
from pbonet.node.ring._ring import Ring
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net.messages import Event

JOB = "JOB j\nDESC\nSBS a.sbs\nTASK a\nTASK b\n{}EOF\n"


def book(told, *lines):
    """Return what a job with these RECORD lines is recorded like."""
    job = parse_job(JOB.format("".join(f"RECORD {line}\n" for line in lines)))
    made = RecordingControl(told)
    made.of(job, SimpleNamespace(table=SimpleNamespace(variables=[])))
    return made.mode, made.last, made._tasks


@pytest.mark.parametrize(
    ("told", "lines", "wanted"),
    [
        (None, (), ("outputs", 0.0, {})),
        (None, ("last 60",), ("outputs", 60.0, {})),
        (None, ("all a", "last 5"), ("outputs", 5.0, {"a": "all"})),
        ("last 30", ("all a", "last 5"), ("outputs", 30.0, {"a": "all"})),
        ("all", ("off a", "last 5"), ("all", 0.0, {})),
        ("off", ("last 5",), ("off", 0.0, {})),
    ],
)
def test_the_command_line_goes_before_the_job(told, lines, wanted) -> None:
    assert book(told, *lines) == wanted


@pytest.mark.parametrize("told", ["last", "last x", "last -1", "last inf", "some"])
def test_what_is_no_way_to_record(told) -> None:
    with pytest.raises(LogError, match="this is not a recording mode"):
        RecordingControl(told)


def happened(severity) -> bytes:
    event = Event(
        n=1, time=1, wall=1.0, severity=severity, code="X", rtpu="r", text="it"
    )
    return msgspec.msgpack.encode(event)


def test_what_is_kept_outlasts_its_ring_and_a_disk_that_is_full(tmp_path) -> None:
    """An error comes while no file can be made: it is written as soon as one can."""
    blocked = tmp_path / "runs"
    blocked.write_text("a file where a folder should be")
    named = {"domain": "d", "rtpu": "r", "subsystem": "s"}
    about = TaskAbout(
        **named, task="t", module="m", pid=1, freq=1.0, rmod="", rmod_name="t.rmod"
    )
    said = []
    wanted = rtpu_messages.Recording(
        **named,
        core=0,
        folder=str(blocked / "x"),
        file="run",
        run="x",
        job="j",
        mode="outputs",
        last=600.0,
    )
    recorder = Recorder(wanted, said.append)
    ring = Ring.create("d.s.t", 1 << 12, msgspec.json.encode(about))
    ring.put(b"", cycle=1, now_ns=1)
    recorder.turn()
    ring.put(b"", cycle=2, now_ns=2)
    ring.destroy()
    recorder.turn()
    recorder.take(rtpu_messages.Happened(happened(Severity.WARNING)))
    assert [one.code for one in said if isinstance(one, rtpu_messages.Note)] == []
    recorder.take(rtpu_messages.Happened(happened(Severity.ERROR)))
    assert [one.code for one in said if isinstance(one, rtpu_messages.Note)] == [
        "LOG_FULL"
    ]
    blocked.unlink()
    recorder._files._retry = 0.0
    recorder.end()
    log = Log(blocked / "x")
    assert log.arrays("t")["cycle"].tolist() == [1, 2]
    assert [one["severity"] for one in log.events()] == [30, 40]
