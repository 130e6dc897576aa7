"""What a recorder does about time limits, and rings of others or damaged ones."""

from __future__ import annotations

import errno
import itertools
import os
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from msgspec import structs
from watching import wait_for

from pbonet.config.model import AgentConfig, Variable
from pbonet.log import Log, TaskAbout
from pbonet.master.console.run_end import unrecorded
from pbonet.node.agent.agent import Agent
from pbonet.node.agent.recorder_supervisor import BEFORE, RESTARTS, Recorders, _Child
from pbonet.node.recorder import Time, log_rotation, recorder_process as recording
from pbonet.node.ring._ring import Ring
from pbonet.node.rtpu import orphaned_rings, record_request
from pbonet.node.task import ring_bytes
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import codec, messages as m
from pbonet.xm.net.messages import Event

ABOUT = TaskAbout(
    domain="d",
    rtpu="arm0",
    subsystem="arm",
    task="a",
    module="m",
    pid=1,
    freq=1.0,
    rmod="",
    rmod_name="a.rmod",
)

ERROR = Event(
    n=1, time=1, wall=1.0, severity=40, code="X", rtpu="arm0", text="it", task="a"
)


@pytest.fixture
def ring():
    ring = Ring.create("d.arm.a", 1 << 14, msgspec.json.encode(ABOUT))
    yield ring
    ring.destroy()


def wanted(folder, **limits):
    return rtpu_messages.Recording(
        domain="d",
        rtpu="arm0",
        subsystem="arm",
        core=0,
        folder=str(folder / "r"),
        file="run",
        run="r",
        job="j",
        mode="outputs",
        limits=rtpu_messages.LogLimits(**limits),
    )


def begin(folder, said, **limits):
    return recording.Recorder(wanted(folder, **limits), said.append)


def logs(folder):
    return [one for one in (folder / "r").glob("*.mcap") if one.stat().st_size]


def codes(said):
    return [one.code for one in said if isinstance(one, rtpu_messages.Note)]


def test_a_log_goes_on_in_another_file_by_time(ring, tmp_path) -> None:
    recorder = begin(tmp_path, [], log_minutes=1e-9)
    for n in range(3):
        ring.put(b"", cycle=n + 1, now_ns=n)
        recorder.turn()
    recorder.end()
    log = Log(tmp_path / "r")
    assert len(log.parts) >= 3
    assert [part.about.goes_on for part in log.parts][1:] == [True] * (
        len(log.parts) - 1
    )
    (life,) = log.lives("a")
    assert log.arrays("a")["cycle"].tolist() == [1, 2, 3], "read as one"
    assert len(life.records) == 3


def test_a_log_goes_on_in_another_file_when_it_has_many_chunks(
    ring, tmp_path, monkeypatch
) -> None:
    """Their index is in the recorder's memory, so its size has a limit."""
    monkeypatch.setattr(log_rotation, "MOST_CHUNKS", 2)
    monkeypatch.setattr(recording, "FLUSH", 0.0)
    recorder = begin(tmp_path, [])
    for n in range(5):
        ring.put(b"", cycle=n + 1, now_ns=n)
        recorder.turn()
    recorder.end()
    assert len(Log(tmp_path / "r").parts) >= 2
    assert Log(tmp_path / "r").arrays("a")["cycle"].tolist() == [1, 2, 3, 4, 5]


def test_a_log_that_was_moved_away_for_an_empty_one_goes_on_in_another_file(
    ring, tmp_path, monkeypatch
) -> None:
    """As `logrotate` does with `create`."""
    monkeypatch.setattr(log_rotation, "CHECK", 0.0)
    said: list[rtpu_messages.FromRecorder] = []
    recorder = begin(tmp_path, said)
    path, moved = tmp_path / "r" / "run.mcap", tmp_path / "r" / "run.mcap.1"
    for n in range(3):
        ring.put(b"", cycle=n + 1, now_ns=n)
        recorder.turn()
        if n == 0:
            path.rename(moved)
            path.touch()
    recorder.end()
    assert codes(said) == ["NOT_RECORDED"]
    assert Log(moved).arrays("a")["cycle"].tolist() == [1]
    (other,) = logs(tmp_path)
    assert Log(other).arrays("a")["cycle"].tolist() == [2, 3]


def test_a_log_in_a_folder_that_cannot_be_read_is_not_taken_for_removed(
    tmp_path, monkeypatch
) -> None:
    """As on a network disk that is away."""

    def refused(_self):
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(log_rotation, "CHECK", 0.0)
    said: list[rtpu_messages.FromRecorder] = []
    recorder = begin(tmp_path, said)
    recorder.turn()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", refused)
        recorder.turn()
    recorder.end()
    assert codes(said) == []


def test_a_log_that_was_removed_is_reported_and_goes_on_in_another_file(
    ring, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(log_rotation, "CHECK", 0.0)
    said: list[rtpu_messages.FromRecorder] = []
    recorder = begin(tmp_path, said)
    for n in range(3):
        ring.put(b"", cycle=n + 1, now_ns=n)
        recorder.turn()
        if n == 0:
            (tmp_path / "r").rename(tmp_path / "moved")
    recorder.end()
    assert codes(said) == ["NOT_RECORDED"]
    assert Log(tmp_path / "moved").complete
    assert Log(tmp_path / "moved").arrays("a")["cycle"].tolist() == [1]
    assert Log(tmp_path / "r").arrays("a")["cycle"].tolist() == [2, 3]


def test_rings_are_emptied_while_what_was_kept_is_written(
    tmp_path, monkeypatch
) -> None:
    """It may be much, and a ring of large records is full in some tens of ms."""
    monkeypatch.setattr(log_rotation, "PORTION", 0.0)
    asked = msgspec.structs.replace(wanted(tmp_path), last=600.0)
    recorder = recording.Recorder(asked, [].append)
    ring = Ring.create("d.arm.a", 1 << 12, msgspec.json.encode(ABOUT))
    cycles = itertools.count(1)

    def run():
        """Fill most of the ring, and let the recorder take a pass."""
        for _ in range(20):
            ring.put(b"", cycle=next(cycles), now_ns=1)
        recorder.turn()

    for _ in range(10):
        run()
    recorder.event(ERROR)
    waiting = len(recorder._files._kept)
    for _ in range(5):  # as when many tasks fail at once
        recorder.event(ERROR)
    assert len(recorder._files._kept) == waiting + 5, "no pass is late"
    passes = 0
    while not recorder.pause:
        run()
        passes += 1
    assert passes >= 10
    assert ring.lost == 0
    recorder.end()
    ring.destroy()
    found = Log(tmp_path / "r").arrays("a")["cycle"].tolist()
    assert found == list(range(1, len(found) + 1))
    assert len(found) >= 200, "all that was kept, and what came meanwhile"


def test_the_recorder_rests_in_the_second_after_an_error(ring, tmp_path) -> None:
    """It continues at once only after a portion that was not enough."""
    asked = msgspec.structs.replace(wanted(tmp_path), last=600.0)
    recorder = recording.Recorder(asked, [].append)
    recorder.event(ERROR)
    for cycle in range(1, 4):
        ring.put(b"", cycle=cycle, now_ns=1)
        recorder.turn()
        assert recorder.pause == recording.PERIOD
    recorder.end()
    assert Log(tmp_path / "r").arrays("a")["cycle"].tolist() == [1, 2, 3]


@pytest.mark.parametrize(("code", "state"), [("STATE", "OFF"), ("METHOD", "ERROR")])
def test_the_counts_of_a_task_that_goes_off_or_fails_and_is_killed_are_its_last(
    ring, tmp_path, monkeypatch, code, state
) -> None:
    """Half a second after the counts of that second."""
    now, slots = 100.0, {}
    recorder = recording.Recorder(
        wanted(tmp_path), [].append, Time(lambda: now, 0, "here")
    )
    monkeypatch.setattr(recorder, "_slots", lambda: {"tasks": dict(slots)})
    for at, missed in ((100.0, 4), (100.5, 7)):
        now, slots["a"] = at, {"cycles": 10, "missed": missed, "failed": 0}
        ring.put(b"", cycle=missed, now_ns=1)
        if missed == 7:
            recorder.event(structs.replace(ERROR, code=code, state=state))
        recorder.turn()
    slots.clear()
    recorder.end()
    assert Log(tmp_path / "r").missed() == {"a": 7}


class Clock:
    """A recorder of the last second, by a time of its own."""

    def __init__(self, folder, said):
        self.now = 100.0
        asked = msgspec.structs.replace(wanted(folder), last=1.0)
        by = Time(lambda: self.now, 0, "here")
        self.recorder = recording.Recorder(asked, said.append, by)
        self.files = self.recorder._files

    def turn(self, now, ring=None, cycle=0):
        self.now = now
        if ring is not None:
            ring.put(b"", cycle=cycle, now_ns=1)
        self.recorder.turn()


def test_records_of_which_no_error_wants_a_file_are_not_lost(ring, tmp_path) -> None:
    """No file can be made: lost are those of the second before and after the error."""
    said = []
    blocked = tmp_path / "r"
    blocked.write_text("a file where a folder should be")
    clock = Clock(tmp_path, said)
    clock.turn(100.0, ring, 1)
    clock.recorder.event(ERROR)
    for n, now in enumerate((100.5, 103.0, 104.5, 106.0, 107.5)):
        clock.turn(now, ring, 2 + n)
    assert clock.files.lost == {"a": 2}
    blocked.unlink()
    clock.turn(120.0)
    assert not blocked.exists(), "there is nothing to be written to a file"
    clock.recorder.end()
    assert codes(said) == ["LOG_FULL"]


def test_what_waits_too_long_to_be_written_is_counted_and_told(ring, tmp_path) -> None:
    said = []
    clock = Clock(tmp_path, said)
    clock.files._portion = 0.0  # one at a time: a disk that is slow
    for cycle in range(1, 21):
        clock.turn(100.0 + cycle / 100, ring, cycle)
    clock.recorder.event(ERROR)
    clock.turn(102.3)
    lost = clock.files.lost["a"]
    assert 0 < lost < 20
    clock.recorder.end()
    (note,) = [one for one in said if isinstance(one, rtpu_messages.Note)]
    assert note.code == "NOT_RECORDED"
    assert note.text.startswith(f"{lost} records waited too long for the disk")
    log = Log(tmp_path / "r")
    assert len(log.arrays("a")["cycle"]) == 20 - lost
    assert unrecorded(log, ["arm0"], ["arm0"]) == f"not recorded: {lost} cycles of a"


def test_what_a_ring_lost_after_its_last_record_is_counted(ring, tmp_path) -> None:
    """The disk was too slow until the end: no record says so."""
    recorder = begin(tmp_path, [])
    recorder.turn()
    cycle = 0
    while not ring.lost:
        cycle += 1
        ring.put(b"", cycle=cycle, now_ns=cycle)
    recorder.end()
    log = Log(tmp_path / "r")
    assert log.arrays("a")["cycle"].tolist() == list(range(1, cycle))
    assert log.lost() == {"a": 1}
    assert log.complete


def test_what_a_full_disk_lost_is_counted_in_the_next_file(ring, tmp_path) -> None:
    said = []
    recorder = begin(tmp_path, said)
    blocked = tmp_path / "r"
    blocked.write_text("a file where a folder should be")
    for cycle in (1, 2):
        ring.put(b"", cycle=cycle, now_ns=cycle)
        recorder.turn()
    blocked.unlink()
    recorder._files._retry = 0.0
    ring.put(b"", cycle=3, now_ns=3)
    recorder.turn()
    recorder.end()
    log = Log(tmp_path / "r")
    assert log.arrays("a")["cycle"].tolist() == [3]
    assert log.lost() == {"a": 2}


def test_what_a_lost_recorder_had_lost_is_added_to_what_the_next_one_loses(
    ring, tmp_path
) -> None:
    """What did not fit a ring that stands is counted once: the ring says it."""

    def full(recorder, *cycles):
        for cycle in cycles:
            ring.put(b"", cycle=cycle, now_ns=cycle)
            recorder.turn()

    said = []
    (tmp_path / "r").write_text("a file where a folder should be")
    first = begin(tmp_path, said)
    full(first, 1, 2)
    cycle = 3
    while not ring.lost:  # as it was stopped for a while
        ring.put(b"", cycle=cycle, now_ns=cycle)
        cycle += 1
    first.turn()
    unwritten = cycle - 2  # all but the last one, which did not fit
    assert said[-1].lost == unwritten + 1
    assert said[-1].handed_on == {"a": unwritten}
    for followed in first._rings.values():
        followed.ring.close()  # as its end does
    plan = msgspec.structs.replace(wanted(tmp_path), lost=said[-1].handed_on)
    second = recording.Recorder(plan, said.append)
    full(second, cycle)
    (tmp_path / "r").unlink()
    second._files._retry = 0.0
    full(second, cycle + 1)
    second.end()
    assert Log(tmp_path / "r").lost() == {"a": unwritten + 1 + 1}


def test_a_recorder_that_was_lost_hands_on_what_it_has_lost(
    tmp_path, monkeypatch
) -> None:
    plans = []
    start = _Child._start

    def started(self, before):
        plans.append(self._handed_on)
        return start(self, before)

    monkeypatch.setattr(_Child, "_start", started)
    (tmp_path / "r").write_text("a file where a folder should be")
    recorders = Recorders(lambda _: None, AgentConfig())
    recorders.update({"arm": wanted(tmp_path)})
    ring = Ring.create("d.arm.a", 1 << 14, msgspec.json.encode(ABOUT))
    try:
        ring.put(b"", cycle=1, now_ns=1)
        child = recorders._children["arm"]
        wait_for(lambda: child._handed_on, "that it says what it has lost")
        child._process.kill()
        wait_for(lambda: len(plans) > 1, "the next one")
    finally:
        ring.destroy()
        recorders.stop()
    assert plans == [{}, {"a": 1}]


def test_the_recorder_of_the_next_agent_goes_on_counting_what_is_lost(tmp_path) -> None:
    """The RTPU process keeps the count; a new one in its plan begins no recorder."""
    (tmp_path / "r").write_text("a file where a folder should be")
    rtpu = SimpleNamespace(recordings={"arm": wanted(tmp_path)})

    def take(message: rtpu_messages.FromRecorder) -> None:
        if isinstance(message, rtpu_messages.Recorder):
            record_request.keep_losses(rtpu, message)

    def recorded(cycle: int) -> Recorders:
        recorders = Recorders(take, AgentConfig())
        recorders.update(rtpu.recordings)
        ring.put(b"", cycle=cycle, now_ns=cycle)
        wait_for(lambda: rtpu.recordings["arm"].lost == {"a": cycle}, "the count")
        return recorders

    ring = Ring.create("d.arm.a", 1 << 14, msgspec.json.encode(ABOUT))
    try:
        recorders = recorded(1)
        pids = [*recorders.processes()]
        recorders.update(rtpu.recordings)
        assert [*recorders.processes()] == pids
        recorders.stop()
        recorders = recorded(2)
        wait_for(lambda: recorders.fares("arm").lost == 2, "its status")
    finally:
        ring.destroy()
        recorders.stop()


def test_what_the_recorder_of_an_earlier_run_has_lost_is_no_part_of_this_one(tmp_path):
    rtpu = SimpleNamespace(recordings={"arm": wanted(tmp_path)})
    for run, lost in (("earlier", {}), ("r", {"a": 1})):
        late = rtpu_messages.Recorder(subsystem="arm", run=run, handed_on={"a": 1})
        record_request.keep_losses(rtpu, late)
        assert rtpu.recordings["arm"].lost == lost


@pytest.mark.parametrize(
    ("size", "room"), [(8, 1 << 20), (1_000_000, 16 * 1_000_000), (1 << 30, 1 << 25)]
)
def test_a_ring_has_room_for_some_records_within_a_limit(size, room) -> None:
    picture = Variable(name="P", type="uint8", nelem=size)
    large = msgspec.structs.replace(ABOUT, outvar=[picture])
    assert room <= ring_bytes(large) <= min(max(2 * room, 1 << 20), 1 << 25)


def test_without_a_limit_it_stays_in_one(ring, tmp_path) -> None:
    recorder = begin(tmp_path, [])
    for n in range(3):
        ring.put(b"", cycle=n + 1, now_ns=n)
        recorder.turn()
    recorder.end()
    assert len(Log(tmp_path / "r").parts) == 1


def gone(task="a", pid=7):
    """A task whose process has ended."""
    facts = SimpleNamespace(ring=f"d.arm.{task}")
    return SimpleNamespace(name=task, facts=facts, child=SimpleNamespace(pid=pid))


def files(shared_memory):
    return [one.name.split(".", 3)[-1] for one in shared_memory.glob("*.ring")]


def test_what_a_task_left_before_the_recorder_came_is_in_the_log(
    tmp_path, shared_memory
) -> None:
    """Also where another task of its name is there already."""
    for cycle in (1, 2):
        ring = Ring.create("d.arm.a", 1 << 14, msgspec.json.encode(ABOUT))
        ring.put(b"", cycle=cycle, now_ns=cycle)
        ring.close()
        orphaned_rings.let_ring_go(gone(pid=cycle), wanted(tmp_path))
    assert sorted(files(shared_memory)) == ["arm.a~arm0.1.ring", "arm.a~arm0.2.ring"]
    recorder = begin(tmp_path, [])
    recorder.end()
    assert files(shared_memory) == []
    assert sorted(Log(tmp_path / "r").arrays("a")["cycle"].tolist()) == [1, 2]


def test_a_ring_that_a_recorder_follows_is_removed_and_emptied(
    ring, tmp_path, shared_memory
) -> None:
    recorder = begin(tmp_path, [])
    recorder.turn()
    ring.put(b"", cycle=1, now_ns=1)
    orphaned_rings.let_ring_go(gone(), wanted(tmp_path))
    assert files(shared_memory) == []
    recorder.end()
    assert Log(tmp_path / "r").arrays("a")["cycle"].tolist() == [1]


@pytest.mark.parametrize("tasks", [None, {"a": "off"}])
def test_the_ring_of_a_task_that_nobody_records_is_removed(
    tmp_path, shared_memory, tasks
) -> None:
    Ring.create("d.arm.a", 1 << 14).close()
    asked = msgspec.structs.replace(wanted(tmp_path), tasks=tasks) if tasks else None
    orphaned_rings.let_ring_go(gone(), asked)
    assert files(shared_memory) == []


def test_large_rings_that_no_recorder_comes_for_are_bounded_in_bytes(
    tmp_path, shared_memory, monkeypatch
) -> None:
    monkeypatch.setattr(orphaned_rings, "MOST_BYTES", 3 << 20)
    for pid in range(4):
        Ring.create("d.arm.a", 1 << 21).close()
        orphaned_rings.let_ring_go(gone(pid=pid), wanted(tmp_path))
    assert len(files(shared_memory)) == 2
    orphaned_rings.sweep("d", "arm0")


def test_rings_that_no_recorder_comes_for_are_bounded_and_swept(
    tmp_path, shared_memory
) -> None:
    for pid in range(orphaned_rings.MOST + 1):
        Ring.create("d.arm.a", 1 << 14).close()
        orphaned_rings.let_ring_go(gone(pid=pid), wanted(tmp_path))
    assert len(files(shared_memory)) == orphaned_rings.MOST
    orphaned_rings.sweep("d", "arm")
    orphaned_rings.sweep("e", "arm0")
    assert len(files(shared_memory)) == orphaned_rings.MOST, "they are another one's"
    recorders = Recorders(lambda _: None, AgentConfig(name="arm0", domain="d"))
    agent = SimpleNamespace(
        _begin_to_stop=lambda: None,
        _server=None,
        _recorders=recorders,
        _executives=SimpleNamespace(stop=lambda **_: None),
        _leave=lambda **_: None,
    )
    Agent.abandon(agent)
    assert len(files(shared_memory)) == orphaned_rings.MOST, (
        "the next agent's recorders come"
    )
    recorders.stop()
    assert files(shared_memory) == []


@pytest.mark.parametrize("size", [0, 100, 1 << 14])
def test_a_ring_that_its_task_has_not_finished_is_removed(
    tmp_path, shared_memory, size
) -> None:
    """It was killed as it made it."""
    name = f"pbonet.{os.geteuid()}.d.arm.a.ring"
    (shared_memory / name).write_bytes(bytes(size))
    orphaned_rings.let_ring_go(gone(), wanted(tmp_path))
    assert files(shared_memory) == []
    orphaned_rings.let_ring_go(gone(), wanted(tmp_path))  # it had not begun


@pytest.mark.usefixtures("ring")
def test_a_ring_that_another_drains_is_told_and_left(tmp_path, monkeypatch) -> None:
    other = Ring.attach("d.arm.a")
    other.take()
    said = []
    recorder = begin(tmp_path, said)
    recorder.turn()
    assert not codes(said), "it may be a recorder that is about to end"
    monkeypatch.setattr(recording, "HANDOVER", 0.0)
    recorder.turn()
    assert codes(said) == ["NOT_RECORDED"]
    assert "another process drains this ring" in said[-1].text
    recorder.turn()
    assert codes(said) == ["NOT_RECORDED"], "it is said once"
    recorder.end()
    other.close()
    assert Log(tmp_path / "r").tasks == []


def test_a_damaged_ring_ends_its_own_recording_only(ring, tmp_path) -> None:
    said = []
    about = msgspec.structs.replace(ABOUT, task="b")
    sound = Ring.create("d.arm.b", 1 << 14, msgspec.json.encode(about))
    recorder = begin(tmp_path, said)
    ring.put(b"", cycle=1)
    sound.put(b"", cycle=1)
    recorder.turn()
    ring.put(b"", cycle=2)
    with open(ring.path, "r+b") as file:  # noqa: PTH123 - in place
        file.seek(64)  # where `head` stands
        file.write((1 << 40).to_bytes(8, "little"))
    recorder.turn()
    sound.put(b"", cycle=2)
    recorder.turn()
    assert "NOT_RECORDED" in codes(said)
    recorder.end()
    sound.destroy()
    log = Log(tmp_path / "r")
    assert log.arrays("a")["cycle"].tolist() == [1]
    assert log.arrays("b")["cycle"].tolist() == [1, 2]


def commanded(recorders, subsystem, values=(1.0,), *, short=False, behind=False):
    """Put a command on record; `behind`: return what does, where it cannot wait."""
    request = m.Write(subsystem=subsystem, client="c", name="X", values=list(values))
    answer = codec.Codec().pack(m.Answer(id=request.id, ok=True, result=list(values)))
    said = request, answer, 1, time.monotonic_ns()
    if short and recorders.noted(*said):
        return None
    if behind:
        return lambda: recorders.commanded(*said)
    return recorders.commanded(*said)


def test_more_commands_than_a_pipe_takes_are_in_the_log(tmp_path) -> None:
    said = []
    recorders = Recorders(said.append, AgentConfig())
    recorders.update({}, {"arm": 1})
    try:
        for n in range(BEFORE + 1):
            values = [n, *[0.1234567890123456789] * 79]
            commanded(recorders, "arm", values, short=n % 2 == 0)
        recorders.update({"arm": wanted(tmp_path)}, {"arm": 1})
        commanded(recorders, "arm", [BEFORE + 1], short=True)
        wait_for(lambda: logs(tmp_path), "a log")
    finally:
        recorders.stop()
    assert codes(said) == []
    found = Log(tmp_path / "r").commands()
    first = [one["asked"]["values"][0] for one in found]
    assert first == list(range(1, BEFORE + 2)), "the last ones, in order, once"


def test_a_command_that_is_put_on_record_late_stands_where_it_was_answered(
    tmp_path,
) -> None:
    """Its record waited for a lock, and the next one's found that free."""
    recorders = Recorders(lambda _: None, AgentConfig())
    recorders.update({}, {"arm": 1})
    try:
        with recorders._guard:
            late = commanded(recorders, "arm", [1.0], short=True, behind=True)
        commanded(recorders, "arm", [2.0], short=True)
        late()
        recorders.update({"arm": wanted(tmp_path)}, {"arm": 1})
        wait_for(lambda: logs(tmp_path), "a log")
    finally:
        recorders.stop()
    found = Log(tmp_path / "r").commands()
    assert [one["asked"]["values"] for one in found] == [[1.0], [2.0]]


@pytest.mark.parametrize("short", [False, True])
def test_commands_are_kept_only_of_subsystems_that_hold_a_claim(short) -> None:
    recorders = Recorders(lambda _: None, AgentConfig())
    recorders.update({}, {"arm": 1, "leg": 2})
    for subsystem in ("arm", "leg", *(f"nobody{n}" for n in range(100))):
        commanded(recorders, subsystem, short=short)
    assert recorders._before.keys() == {"arm", "leg"}
    recorders.update({}, {"arm": 1})
    assert recorders._before.keys() == {"arm"}


@pytest.mark.slow
def test_a_recorder_that_is_lost_too_often_is_not_started_again(tmp_path) -> None:
    said = []
    recorders = Recorders(said.append, AgentConfig())
    recorders.update({"arm": wanted(tmp_path)})
    try:
        for n in range(RESTARTS + 1):
            child = recorders._children["arm"]
            wait_for(lambda n=n: len(logs(tmp_path)) > n, "its log")
            child._process.kill()
            wait_for(lambda n=n: len(codes(said)) > n, "its end")
        wait_for(lambda: not child._thread.is_alive(), "that it is given up")
    finally:
        recorders.stop()
    assert codes(said) == ["RECORDER_DIED"] * (RESTARTS + 1)
    texts = [one.text for one in said]
    assert all(text.endswith("another one continues") for text in texts[:-1])
    assert texts[-1].endswith("recording has stopped")
    assert len(Log(tmp_path / "r").parts) == RESTARTS + 1


def test_a_recorder_that_cannot_be_started_again_at_once_is_so_later(
    tmp_path, monkeypatch
) -> None:
    refusals = [errno.EMFILE] * 3
    create = os.memfd_create

    def refused(name):
        if refusals:
            number = refusals.pop()
            raise OSError(number, os.strerror(number))
        return create(name)

    said = []
    recorders = Recorders(said.append, AgentConfig())
    recorders.update({"arm": wanted(tmp_path)}, {"arm": 1})
    monkeypatch.setattr("pbonet.node.agent.recorder_supervisor.AGAIN_TIME", 0.01)
    try:
        wait_for(lambda: logs(tmp_path), "a log")
        monkeypatch.setattr(os, "memfd_create", refused)
        recorders._children["arm"]._process.kill()
        wait_for(lambda: len(logs(tmp_path)) > 1, "another log")
        commanded(recorders, "arm")
    finally:
        recorders.stop()
    assert codes(said) == ["RECORDER_DIED"] * 2
    assert said[0].text.endswith("another one continues")
    assert "could not be started again: [Errno 24] Too many" in said[1].text
    assert said[1].text.endswith("it is tried again")
    assert len(Log(tmp_path / "r").commands()) == 1


def test_a_burst_behind_the_start_kills_no_recorder(tmp_path) -> None:
    said, burst = [], 400
    recorders = Recorders(said.append, AgentConfig())
    try:
        recorders.update({"arm": wanted(tmp_path)}, {"arm": 1})
        for n in range(burst):  # of 1.5 kB each, while it is still being started
            commanded(recorders, "arm", [n, *[0.1234567890123456789] * 60])
        wait_for(lambda: logs(tmp_path), "a log")
    finally:
        recorders.stop()
    assert codes(said) == []
    asked = [one["asked"]["values"][0] for one in Log(tmp_path / "r").commands()]
    assert asked == list(range(burst)), "each one, in order"


def test_the_version_of_numpy_is_found_without_loading_what_reads_packages(
    monkeypatch,
):
    """It is a sixth of what a recorder loads, beside the first tasks of a run."""
    code = (
        "import sys; from pbonet.node.recorder import log_rotation, recorder_process\n"
        "print(log_rotation.numpy_version(), 'importlib.metadata' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [metadata.version("numpy"), "False"]
    found = [one for one in sys.path if not [*Path(one).glob("numpy-*.dist-info")]]
    monkeypatch.setattr(sys, "path", found)
    with pytest.raises(metadata.PackageNotFoundError, match="numpy"):
        log_rotation.numpy_version()
