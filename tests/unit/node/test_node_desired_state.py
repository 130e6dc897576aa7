"""What an agent keeps for a restart: its file, and what is called off meanwhile."""

from __future__ import annotations

import errno
import json
import os
import threading
from pathlib import Path
from queue import Queue

import msgspec
import pytest
from xm_rig import agent_info

from pbonet.node.restart import DesiredState, TaskRestarts
from pbonet.node.restart.desired_state import StopLeft, Subsystem
from pbonet.node.restart.task_restarts import CALLED_OFF
from pbonet.xm.net import codec, messages as m

MARK = "again-"
LEFT = StopLeft(id="s0", subsystem="arm", due=["arm1"], machines={"arm1": "boot"})


def spawn(task):
    return m.Spawn(task=task, rmod="", rmod_name=f"{task}.rmod", restart="on")


def subsystem(*tasks, **more):
    """Return what is kept of tasks that were ON."""
    return Subsystem(
        claim=m.Claim(subsystem="arm", client="m1", keeper="arm9"),
        epoch=1,
        requests=[spawn(task) for task in tasks],
        on=list(tasks),
        **more,
    )


@pytest.fixture
def notes():
    return Queue()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "state" / "d" / "arm0.json"


def state_at(path, notes):
    """Return a state with a task that is ON, as the agent of the RTPU has it."""
    state = DesiredState(path, notes.put, MARK)
    state.subsystems["arm"] = subsystem("t0")
    return state


def stopped(state, v=1):
    """Have a stop carried out, and its answer taken in; return what is answered."""
    request = m.Stop(v=v, id="1", client="c", subsystem="arm", stop_id="s1")
    answer = m.Answer(v=v, id="1", ok=True, result=m.Stopped(off=["t0"], killed=[]))
    data = codec.Codec().pack(answer)
    state.done(request, data)
    return msgspec.msgpack.decode(state.warned(data), type=m.Answer)


def path_of(fd):
    return Path(f"/proc/self/fd/{fd}").readlink()


def kept_on(path):
    """Return the tasks that an agent which starts now would turn on."""
    state = DesiredState(path, lambda _: None, MARK)
    state.load()
    return [task for one in state.subsystems.values() for task in one.on]


# -- the file ---


@pytest.mark.parametrize("orders", [[], [LEFT]], ids=["removed", "replaced"])
def test_what_is_answered_to_a_stop_is_on_the_disk(path, notes, monkeypatch, orders):
    """The name, too: else a power cut after the answer brings the old file back."""
    state = state_at(path, notes)
    state.write()
    done, real = [], os.fsync

    def fsync(fd):
        where = path_of(fd)
        done.append((where, path.exists() and "t0" in path.read_text()))
        real(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    state.orders_of = lambda: orders
    stopped(state)
    assert (path.parent, False) in done, "the folder, after the change"
    assert path.exists() == bool(orders)


def test_a_new_folder_is_on_the_disk(path, notes, monkeypatch):
    done = []
    monkeypatch.setattr(os, "fsync", lambda fd: done.append(path_of(fd)))
    state_at(path, notes).write()
    assert {path.parent.parent, path.parent} <= {*done}


def test_it_is_written_after_the_shared_memory_was_removed(
    path, notes, tmp_path, monkeypatch
):
    """The agent writes it once more as it ends for that reason."""
    shared = tmp_path / "shm"
    shared.mkdir(mode=0o700)
    monkeypatch.setenv("PBONET_SHM_DIR", str(shared))
    state = state_at(path, notes)
    shared.rmdir()
    state.write()
    assert "t0" in path.read_text()


@pytest.fixture
def disk(monkeypatch):
    """A disk that is full from `full.set()` on, for what is written to it."""
    full, real = threading.Event(), os.fsync

    def fsync(fd):
        if full.is_set() and path_of(fd).suffix == ".new":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    return full


def test_a_stop_on_a_full_disk_brings_nothing_back_and_warns_each_time(
    path, notes, disk
):
    state = state_at(path, notes)
    state.write()
    assert kept_on(path) == ["t0"]
    disk.set()
    state.orders_of = lambda: [LEFT]
    state.write()  # the series has begun, and is told
    assert notes.get_nowait().code == "STATE_NOT_KEPT"
    (warning,) = stopped(state).warnings
    assert "cannot be kept for a restart of the machine" in warning
    assert str(path) in warning
    assert os.strerror(errno.ENOSPC) in warning
    assert kept_on(path) == []
    assert not list(path.parent.iterdir())
    assert notes.empty()
    disk.clear()
    state.write()
    assert json.loads(path.read_text())["orders"][0]["id"] == "s0"
    assert stopped(state).warnings == []


def test_a_file_that_cannot_be_removed_is_named_in_the_answer(path, notes, monkeypatch):
    state = state_at(path, notes)
    state.write()

    def refuse(*_args, **_more):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    (warning,) = stopped(state).warnings
    assert warning.endswith(f"; remove {path}, else what it says comes back")


def test_room_that_the_old_file_takes_is_used(path, notes, monkeypatch):
    state = state_at(path, notes)
    state.write()
    real = os.fsync

    def fsync(fd):
        if path.exists() and path_of(fd).suffix == ".new":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    state.orders_of = lambda: [LEFT]
    assert stopped(state).warnings == []
    assert json.loads(path.read_text())["orders"][0]["id"] == "s0"


@pytest.mark.parametrize("v", [1, 99])
def test_a_stop_of_any_version_is_kept(path, notes, v):
    state = state_at(path, notes)
    state.orders_of = lambda: [LEFT]
    state.write()
    assert stopped(state, v).v == v
    assert kept_on(path) == []
    assert state.stops == ["s1"]


@pytest.mark.parametrize("change", ["a request", "what is kept"])
def test_orders_for_others_survive_a_version_with_other_requests(path, notes, change):
    state = state_at(path, notes)
    state.orders_of = lambda: [LEFT]
    state.carried_out("s9")
    state.write()
    found = json.loads(path.read_text())
    if change == "a request":
        del found["subsystems"]["arm"]["requests"][0]["rmod"]
    else:
        found["subsystems"]["arm"]["on"] = 1
    path.write_text(json.dumps(found))
    later = DesiredState(path, notes.put, MARK)
    damage = later.load()
    assert "no task is spawned again (the stops of other RTPUs were read)" in damage
    assert (later.subsystems, later.orders, later.stops) == ({}, [LEFT], ["s9"])
    assert path.with_suffix(".bad").exists()
    later.begin(taken_over=False)
    later.close(keep=False)
    assert json.loads(path.read_text())["orders"][0]["id"] == "s0"


# -- tasks that wait to be turned on ---


class Keeper:
    """The other agents: the keeper answers and has the subsystem."""

    def __init__(self, *masters):
        self.alive = masters

    def rtpus(self):
        return ["arm9"]

    def masters(self, _subsystem):
        return list(self.alive)

    def call_all(self, requests, _result):
        info = agent_info("arm9", machine="b", claims={"arm": 7})
        return dict.fromkeys(requests, info), []


class Node:
    """The RTPU process: turns on what it is told to, and does `meanwhile` before."""

    def __init__(self, meanwhile=lambda: None):
        self.on, self.meanwhile = [], meanwhile

    def submit(self, request, reply):
        assert request.signal == "on"
        self.on.append(request.task)
        self.meanwhile()
        status = {"state": "ON", "task": request.task, "rmod": "r", "rtpu": "arm0"}
        numbers = (
            "tid crit cycle miss ref_f mez_f mez_t ptime tot_c tick min_c max_c last_c "
            "warn lost_n"
        )
        status |= dict.fromkeys(numbers.split(), 0) | {"S": ""}
        reply(codec.Codec().pack(m.Answer(id=request.id, ok=True, result=status)))


def come_back(state, notes, node, keeper):
    """Give the tasks again; return those turned on, and why others stay OFF."""
    restarts = TaskRestarts("arm0", state, keeper, node, note=notes.put, mark=MARK)
    restarts.begin("lost")
    (run,) = restarts._runs
    run.thread.join()
    restarts.stop()
    return node.on, state.subsystems["arm"].notes


@pytest.fixture
def waiting(notes):
    """Two tasks that were spawned again, and wait for the keeper."""
    state = DesiredState(None, notes.put, MARK)
    stages = {"a": "waits", "b": "waits"}
    state.subsystems["arm"] = subsystem("a", "b", stages=stages)
    return state


class Infos(dict):
    """The greetings, which are read once more before each task is turned on."""

    def __init__(self, infos, read):
        super().__init__(infos)
        self.read = read

    def items(self):
        self.read()
        return super().items()


@pytest.mark.parametrize("when", ["while the first one comes on", "just before its on"])
def test_a_task_that_is_replaced_while_another_comes_on_stays_off(
    waiting, notes, monkeypatch, when
):
    def replace():
        if node.on:
            waiting.replaced("arm", ["b"])

    def call_all(*given):
        return Infos(Keeper.call_all(keeper, *given)[0], replace), []

    node, keeper = Node(replace), Keeper()
    if when == "just before its on":
        node.meanwhile = lambda: None
        monkeypatch.setattr(keeper, "call_all", call_all)
    monkeypatch.setattr("pbonet.node.restart.task_restarts.TURN", 0.01)
    on, why = come_back(waiting, notes, node, keeper)
    assert on == ["a"]
    assert why["b"].endswith(f"spawned again, OFF: {CALLED_OFF}")


def claimed(state, epoch):
    request = m.Claim(id="1", client="m2", subsystem="arm", keeper="arm9")
    answer = m.Answer(id="1", ok=True, result={"epoch": epoch})
    state.done(request, codec.Codec().pack(answer))


@pytest.mark.parametrize(("epoch", "on"), [(1, ["a", "b"]), (2, [])])
def test_what_waits_is_called_off_by_another_master_and_not_by_the_same(
    waiting, notes, epoch, on
):
    claimed(waiting, epoch)
    found, why = come_back(waiting, notes, Node(), Keeper("m2"))
    assert found == on
    assert all(text.endswith(CALLED_OFF) for text in why.values())
    assert len(why) == 2 - len(on)


@pytest.mark.parametrize(
    ("masters", "on"), [((), ["a", "b"]), (("m1",), ["a", "b"]), (("m2",), [])]
)
def test_what_waits_is_called_off_by_a_master_that_has_not_come_here(
    waiting, notes, masters, on
):
    """It has claimed the keeper, which is what was waited for, and goes on."""
    found, _ = come_back(waiting, notes, Node(), Keeper(*masters))
    assert found == on
