"""Tasks and RTPUs at one time of a recorded run, as far as its log holds them."""

from __future__ import annotations

import random

import pytest
from made_logs import PLAIN, about, group, record, run

from pbonet.log import Log, LogWriter
from pbonet.master.web.recorded_states import RecordedStates

HZ = 100
MS = 10**6
GRAPH = {
    "tasks": [
        {"name": name, "rtpu": "arm0", "freq": freq, "fallback_of": ""}
        for name, freq in (("pid", HZ), ("quiet", 0), ("unseen", 0))
    ],
    "rtpus": [{"name": "arm0"}],
}


@pytest.fixture
def states(tmp_path):
    """A task that is ON from 0.5 s, of which misses and CPU are known, and another."""
    writer = LogWriter(tmp_path / "run.mcap", run())
    pid, quiet = (writer.add_task(about(one, PLAIN)) for one in ("pid", "quiet"))
    data = group(PLAIN, random.Random(1))[0]

    def happened(ms, code, text="", **more):
        about_ = {"severity": 20, "code": code, "text": text, "rtpu": "arm0"}
        writer.add_event({"time": ms * MS, "wall": ms / 1000, **about_, **more})

    happened(0, "SPAWNED", task="pid", state="OFF")
    happened(500, "STATE", task="pid", state="ON")
    for n in range(350):
        at = (500 + 10 * n) * MS
        times = {"release_ns": at, "start_ns": at, "end_ns": at}
        writer.add(pid, record(data, cycle=n + 1, cpu_ns=2 * MS, **times))
        writer.add(quiet, record(data, cycle=n + 1, **times))
    for second, missed in enumerate((0, 2, 3, 3)):
        counts = {"cycles": 100 * second, "missed": missed, "failed": second // 2}
        writer.add_status(second * 1000 * MS, {"tasks": {"pid": counts}})
    happened(2000, "ILLEGAL", "no task writes X (raised by pid)")
    happened(3000, "LEGAL", "[3 changes] no longer: no task writes X (raised by pid)")
    writer.close()
    return RecordedStates(Log(tmp_path), GRAPH)


def fields(states, at):
    return {one["task"]: one["fields"] for one in states.at(at)["tasks"]}


def test_misses_failures_and_cpu_are_those_until_a_time(states):
    found = fields(states, 2.5)["pid"]
    assert (found["miss"], found["failed"]) == (3, 1)
    assert found["avgC"] == pytest.approx(0.002)
    assert found["avgU"] == pytest.approx(20.0)
    assert found["mezF"] == pytest.approx(100, abs=1)
    assert found["cycle"] == pytest.approx(200, abs=1)
    (rtpu,) = states.at(2.5)["rtpus"]
    assert rtpu["load"] == pytest.approx(0.2)


def test_what_is_not_known_is_not_zero(states):
    early = fields(states, 0.7)["pid"]  # since it is ON nothing was counted yet
    assert early["miss"] is early["failed"] is None
    quiet, unseen = (fields(states, 2.5)[one] for one in ("quiet", "unseen"))
    assert quiet["avgU"] is quiet["miss"] is None
    assert unseen["cycle"] is unseen["mezF"] is None
    assert states.lacks == [
        "the log holds no misses and failures of quiet",
        "the log holds no CPU times of quiet",
        "the log holds no cycles of unseen",
    ]


def test_the_flag_has_its_causes_of_that_time(states):
    causes = [states.at(at)["rtpus"][0]["illegal"] for at in (1.9, 2.1, 3.1)]
    assert causes == [[], ["no task writes X (raised by pid)"], []]
