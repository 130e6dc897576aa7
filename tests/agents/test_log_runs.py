"""Runs of real tasks are recorded whole, and what is recorded is verified.

The faults: recorder, agent and task are killed, the disk is full.
"""

from __future__ import annotations

import contextlib
import os
import signal

import mounting
import pytest
from adding_module import ADDS
from drawing_module import draws
from log_of_real_tasks import (
    TEXT,
    begin,
    cycles_of,
    end,
    exercise,
    recorder,
    spawn,
    without_a_hole,
)
from logviewers import by_mcap, must_agree, ours
from mcap.reader import make_reader
from nodekit import Master
from watching import wait_for

from pbonet.errors import LogError, ModuleLoadError, PbonetError
from pbonet.log import Log, is_complete
from pbonet.testing import DivergedError, replay, verify
from pbonet.xm.net import messages as m

DRAWS = draws("self.made.normal()", first="self.task.rng")


@pytest.fixture
def line(nodes):
    """Two tasks in a line, X to a to Y0 to b to Y1, by an agent of its own process."""
    nodes.write_module("adds", ADDS)
    nodes.agent_process("arm0")
    return nodes.master("arm0", "arm")


def test_a_run_is_recorded_whole_and_gives_the_same_again(line, nodes):
    path = begin(line, files={"arm.sbs": "SUBSYSTEM arm"}, job="adding")
    exercise(line)
    last = line.status("b").cycle
    log = end(line, path)
    assert log.about["job"] == "adding"
    assert log.attached["arm.sbs"].data == b"SUBSYSTEM arm"
    assert log.attached["a.rmod"].data.decode() == TEXT.format(z="X", y="Y0")
    assert log.lost() == {}
    for task in ("a", "b"):
        assert without_a_hole(cycles_of(*log.lives(task)))
    assert cycles_of(*log.lives("b"))[-1] >= last
    codes = [event["code"] for event in log.events()]
    assert codes.count("SPAWNED") == 2
    assert [one for one in log.messages("json") if one.topic == "arm/status/arm0"]
    verdicts = verify(log)
    assert all(one.good for one in verdicts), "\n".join(map(str, verdicts))

    # The module changes: its lines are named, and the first other value.
    nodes.write_module("adds", ADDS.replace("dt / 3.0", "dt / 3.5"))
    with pytest.raises(DivergedError) as caught:
        replay(path, "b")
    text = str(caught.value)
    assert text.startswith("b differs from its log: cycle 1: Y1[0] is ")
    assert f"(0 of {len(log.arrays('b')['cycle'])} cycles identical; " in text
    assert "adds.py has changed: " in text
    number = ADDS.splitlines().index("        self.age += dt / 3.0") + 1
    assert f", lines {number}); correct the module" in text
    assert replay(path, "b", rtol=1.0).good
    (nodes.library / "adds.py").unlink()
    with pytest.raises(ModuleLoadError):
        replay(path, "b")


def test_what_real_tasks_draw_is_drawn_again(line, nodes):
    nodes.write_module("adds", DRAWS)
    path = begin(line)
    wait_for(lambda: line.status("b").cycle > 9, "some cycles")
    line.kill("a")
    spawn(line, "a", "X", "Y0")
    line.on("a")
    wait_for(lambda: line.status("a").cycle > 9, "some cycles of the second life")
    log = end(line, path)
    seeds = {life.about.seed for task in "ab" for life in log.lives(task)}
    assert len(seeds) == 3
    verdicts = verify(log)
    assert all(one.good for one in verdicts), "\n".join(map(str, verdicts))


def test_others_read_every_channel(line):
    path = begin(line, mode="all")
    line.wait_cycles("b", 40)
    log = end(line, path)
    mine = ours(log)
    assert set(mine) == {
        *("arm/a", "arm/b", "arm/a/steps", "arm/b/steps"),
        *("arm/events", "arm/status/arm0", "arm/commands"),
    }
    must_agree(by_mcap(path), mine)
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert {one.name for one in reader.iter_attachments()} == set(log.attached)
    (part,) = log.parts
    assert summary.statistics.message_count == part.count
    assert part.count < sum(map(len, mine.values())), "cycles share messages"


def test_modes_by_task_and_hidden_variables(line):
    path = begin(line, mode="all", tasks={"a": "off"})
    line.wait_cycles("b", 20)
    log = end(line, path)
    assert log.tasks == ["b"]
    assert replay(path, "b").good, "what others do not record is in its own records"

    path = begin(line, run="hidden", hidden=["Y0"])
    line.wait_cycles("b", 20)
    log = end(line, path)
    assert log.variables("a") == []
    assert log.variables("b") == ["Y1"]
    b = verify(log, ["b"])[0]
    assert not b.good
    assert b.divergence is None
    assert b.gaps[0].endswith("Y0 is not recorded")


def test_what_cannot_be_recorded_is_refused(line):
    for more in ({"run": "../up"}, {"run": "a", "file": ""}, {"mode": "some"}):
        error = line.refused(LogError, line.ask, m.Record(**more))
        assert "this is no" in str(error)
    assert line.ask(m.Record(mode="off"), m.Recorded).path == ""


def is_logged(path, task):
    """Tell whether a whole chunk with cycles of the task is in the file."""
    try:
        return bool(cycles_of(*Log(path).lives(task)))
    except PbonetError:  # nothing of it yet
        return False


def test_a_killed_recorder_is_felt_by_nobody(line, nodes):
    path = begin(line)
    before = line.wait_cycles("b", 50)
    wait_for(lambda: is_logged(path, "b"), "cycles on the disk")
    os.kill(recorder(nodes), signal.SIGKILL)
    line.wait_event("RECORDER_DIED")
    wait_for(lambda: line.rtpu_status().log.endswith("run-2.mcap"), "another log")
    after = line.wait_cycles("b", 50)
    assert after.tid == before.tid
    log = end(line, path)
    first, second = (Log(path.with_name(name)) for name in ("run.mcap", "run-2.mcap"))
    assert [one.parts[0].complete for one in (first, second)] == [False, True]
    assert without_a_hole(cycles_of(*first.lives("b")))
    cycles = cycles_of(*second.lives("b"))
    assert without_a_hole(cycles)
    assert cycles[-1] >= after.cycle
    assert len(log.lives("b")) == 2
    assert "begins amid the task's life" in str(verify(log, ["b"])[0])


def test_a_killed_agent_ends_the_log_and_the_next_begins_another(line, nodes):
    path = begin(line)
    line.wait_cycles("b", 50)
    old = recorder(nodes)
    nodes.processes["arm0"].kill()
    nodes.processes["arm0"].wait()
    nodes.forget_session()
    wait_for(lambda: is_complete(path), "the end of the first log")
    nodes.agent_process("arm0")
    master = Master(nodes, "arm0", "arm")
    wait_for(lambda: master.rtpu_status().log.endswith("run-2.mcap"), "another log")
    assert recorder(nodes) != old
    master.wait_cycles("b", 50)
    log = end(master, path)
    assert [part.complete for part in log.parts] == [True, True]
    lives = [Log(path).lives("b")[0], Log(path.with_name("run-2.mcap")).lives("b")[0]]
    assert without_a_hole(cycles_of(*lives)), "the ring has kept what came between"


def test_a_killed_task_leaves_its_cycles(line):
    path = begin(line)
    status = line.wait_cycles("b", 50)
    os.kill(status.tid, signal.SIGKILL)
    line.wait_event("TASK_DIED", "b")
    line.kill("b")
    spawn(line, "b", "Y0", "Y1")
    line.on("b")
    line.wait_cycles("b", 50)
    log = end(line, path)
    first, second = log.lives("b")
    assert len(first.commits) >= status.cycle
    assert len(second.commits) > 50
    assert verify(log, ["b"])[0].good


@pytest.fixture
def small(tmp_path):
    """A file system of 3 MiB: more than a log that nobody looks at for seconds."""
    folder = tmp_path / "small"
    folder.mkdir()
    with mounting.tmpfs(folder, "3m"):
        yield folder


@pytest.mark.mounts
def test_a_full_disk_is_told_and_felt_by_nobody(small, nodes):
    nodes.write_module("adds", ADDS)
    nodes.agent_process("arm0", runs=str(small))
    line = nodes.master("arm0", "arm")
    path = begin(line, mode="all")
    before = line.wait_cycles("b", 20)
    fill = small / "fill"
    with contextlib.suppress(OSError), fill.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    line.wait_event("LOG_FULL")
    wait_for(lambda: line.rtpu_status().unlogged > 0, "lost records")
    line.wait_cycles("b", 50)
    fill.unlink()
    line.wait_event("LOG_CONTINUED")
    line.wait_cycles("b", 50)
    assert line.status("b").tid == before.tid
    log = end(line, path)
    first = Log(path).parts[0]
    assert not first.complete
    first.check()
    assert first.damage == []
    assert first.count > 0
    assert sum(part.complete for part in log.parts) == 1
