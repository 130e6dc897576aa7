"""Why a task of the job is on no RTPU."""

from __future__ import annotations

import pytest

from pbonet.config import Library, parse_job
from pbonet.errors import NodeError
from pbonet.master.configuration import Files
from pbonet.master.subsystem import find_missing
from pbonet.xm.net import messages as m


@pytest.fixture
def files(puma):
    return Files(puma.with_name("puma.job"), Library())


def status(rtpu, **settings):
    base = {"backend": "fifo", "scheduler": "MUF", "tasks": []}
    return m.RtpuStatus(rtpu=rtpu, **(base | settings))


@pytest.mark.parametrize(
    ("there", "reason"),
    [
        ([], "not known, because RTPU arm1 does not answer"),
        ([{"scheduler": ""}], "no master uses the RTPU"),
        (
            [{"scheduler": "", "age": 7200.0}],
            "no master uses the RTPU, whose process was started 2 hours ago",
        ),
        ([{}], "it was not spawned, or was killed"),
        (
            [{"age": 119.0}],
            "it was not spawned, or was killed, since the RTPU process was started, "
            "119 s ago",
        ),
    ],
)
def test_the_reason_says_what_is_known(files, there, reason):
    found = find_missing(files, [status("arm1", **one) for one in there])
    assert {one.task: one.reason for one in found}["qrdiff"] == reason


def test_a_standby_is_named_too_where_its_original_is(files):
    text = "JOB j\nDESC\nSBS puma.sbs\nTASK qrdiff arm1 FALLBACK puma_pidg\nEOF\n"
    files.job = parse_job(text, "j.job")
    found = find_missing(files, [])
    assert [(one.task, one.rtpu) for one in found] == [
        ("qrdiff", "arm1"),
        ("puma_pidg", "arm1"),
    ]


def test_a_standby_on_an_rtpu_of_its_own_is_named_there(files, monkeypatch):
    text = "JOB j\nDESC\nSBS puma.sbs\nTASK qrdiff arm0 FALLBACK spare\nEOF\n"
    files.job = parse_job(text, "j.job")
    own = {"spare": "arm1"}
    monkeypatch.setattr(files, "rtpu_of", own.get)
    found = {one.task: one.rtpu for one in find_missing(files, [])}
    assert found == {"qrdiff": "arm0", "spare": "arm1"}


def test_without_a_job_nothing_is_missing(puma):
    assert find_missing(Files(puma, Library()), []) == []


def test_the_reason_is_that_of_the_error_where_there_is_one(files):
    error = NodeError("the RTPU process has ended and is being started again")
    found = find_missing(files, [], {"arm1": error})
    reasons = {one.task: one.reason for one in found}
    assert reasons["qrdiff"] == (
        "not known, because RTPU arm1 does not answer: the RTPU process has ended and "
        "is being started again"
    )
    assert reasons["puma_pidg"] == "not known, because RTPU arm0 does not answer"
