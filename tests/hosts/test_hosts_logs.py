"""Logs of two machines whose clocks are far apart become one, by what was measured."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hostfleet import Desk
from watching import wait_for

from pbonet.errors import PbonetError
from pbonet.log import Log, is_complete
from pbonet.log.clocks import MEASURED, SAME
from pbonet.log.rewrite import merge
from pbonet.xm.net import messages as m

AHEAD = 7000
"""Seconds by which the clock of host b is ahead."""


@pytest.fixture(scope="module")
def clocks():
    return {"b": AHEAD}


def on_record(path):
    """Tell whether a log says how far clocks are apart."""
    try:
        return any("/clocks/" in one.topic for one in Log(path).messages("json"))
    except PbonetError:  # nothing of it yet
        return False


def test_two_machines_logs_are_merged_by_measured_clocks(lab, tmp_path) -> None:
    for name, host, connect in (("arm0", "a", ()), ("arm1", "b", ("a",))):
        dials = [lab.endpoint(other, host) for other in connect]
        runs = str(tmp_path / name)
        lab.start(name, host, connect=dials, runs=runs, wait=False)
    lab.wait_all()
    desk = Desk(lab, "cell", ("arm0", "arm1"))
    paths = {
        rtpu: Path(desk.ask(rtpu, m.Record(run="r", file=rtpu), m.Recorded).path)
        for rtpu in desk.rtpus
    }
    desk.spawn("arm0", "src", "counts", out="Z0")
    desk.spawn("arm1", "sink", "holds", out="Z2", invar="Z0", local={"level": 1.0})
    desk.on("arm0", "src")
    desk.on("arm1", "sink")
    for path in paths.values():
        wait_for(lambda path=path: on_record(path), "clocks on record")
    for rtpu in desk.rtpus:
        desk.ask(rtpu, m.Record(mode="off"), m.Recorded)
    folder = tmp_path / "both"
    folder.mkdir()
    for rtpu, path in paths.items():
        wait_for(lambda path=path: is_complete(path), "the end of a log")
        shutil.copy(path, folder / f"{rtpu}.mcap")
    desk.close()

    log = Log(folder)
    here, there = log.clocks
    assert (here.how, there.how) == (SAME, MEASURED)
    ahead = here.epoch_ns - there.epoch_ns
    assert abs(ahead - AHEAD * 10**9) <= there.within_ns
    src, sink = (log.arrays(task)["release_ns"] for task in ("src", "sink"))
    assert src[0] < sink[-1]
    assert sink[0] < src[-1], "they ran at one time"
    done = merge([folder], tmp_path / "one.mcap")
    assert done.clocks == log.clocks
    one = Log(tmp_path / "one.mcap")
    assert one.arrays("sink")["release_ns"].tolist() == sink.tolist()
