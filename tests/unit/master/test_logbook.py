"""What the RECORD lines of a job ask the agents for."""

from __future__ import annotations

import pytest
from nodekit import rmod, svar

from pbonet.config.library import Library
from pbonet.errors import ConfigError
from pbonet.master.configuration.subsystem_files import Files
from pbonet.master.subsystem.recording_control import RecordingControl
from pbonet.xm.net import messages as m

JOB = """
JOB  watch
DESC a task and its standby
SBS  t.sbs
TASK first arm0 FALLBACK second
TASK hold  arm0
{record}
EOF
"""


class Fleet:
    """Agents that take every request."""

    names = ("arm0",)

    def __init__(self):
        self.taken = []

    def each(self, request, _answer):
        self.taken += [request(name) for name in self.names]
        return {}, []


@pytest.fixture
def asked(tmp_path):
    """Return what a job with these RECORD lines asks for."""
    (tmp_path / "t.sbs").write_text("SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nEOF\n")
    (tmp_path / "t.svar").write_text(svar())
    for name in ("first", "second", "hold"):
        (tmp_path / f"{name}.rmod").write_text(rmod("counts"))

    def one(record):
        path = tmp_path / "watch.job"
        path.write_text(JOB.format(record=record))
        files, book, fleet = Files(path, Library([])), RecordingControl(), Fleet()
        book.of(files.job, files)
        book.begin(fleet, files, pytest.fail)
        (request,) = fleet.taken
        assert isinstance(request, m.Record)
        return request

    return one


def test_a_fallback_is_recorded_as_the_job_says(asked):
    request = asked("RECORD off\nRECORD all second\nRECORD off Y1")
    assert request.mode == "off"
    assert request.tasks == {"second": "all"}
    assert request.hidden == ["Y1"]


def test_what_is_no_task_is_refused(asked):
    with pytest.raises(ConfigError, match="RECORD all names secnd") as caught:
        asked("RECORD all secnd")
    assert "second" in caught.value.remedy
