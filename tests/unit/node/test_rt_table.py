"""The core table's file: made, shared, found stale, refused."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import mounting
import pytest
from watching import wait_for

from pbonet.analysis.schedule.records import Kind, Mode
from pbonet.errors import NodeError, RealTimeError
from pbonet.node.rt import _rt

ROOT = Path(__file__).parents[3]


@pytest.fixture
def shm(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def path(shm):
    return shm / f"pbonet.{os.geteuid()}.core1"


@pytest.fixture
def table(path):
    table = _rt.CoreTable(1)
    yield table
    table.close()
    path.unlink(missing_ok=True)


def test_the_file_is_the_users_own_and_goes_with_its_member(path) -> None:
    table = _rt.CoreTable(1)
    assert table.path == str(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.stat().st_blocks * 512 >= path.stat().st_size, "not all allocated"
    table.close()
    table.close()
    assert not path.exists()


def test_a_dropped_table_leaves_as_well(path) -> None:
    _rt.CoreTable(1)
    assert not path.exists()


@pytest.mark.usefixtures("shm")
def test_a_user_needs_a_table_that_stands() -> None:
    with pytest.raises(
        NodeError, match=r"core1: the core has no table; start an agent"
    ):
        _rt.CoreTable(1, member=False)


def test_users_do_not_keep_the_table(path) -> None:
    member, user = _rt.CoreTable(1), _rt.CoreTable(1, member=False)
    i = member.alloc("r", "t")
    assert user.snapshot(i).task == "t"
    with pytest.raises(NodeError, match="only a member of the core takes slots"):
        user.alloc("r", "u")
    member.close()
    assert not path.exists()
    assert user.snapshot(i).task == "t", "what is mapped stays readable"
    user.close()


def test_two_members_share_one_table(path) -> None:
    one, two = _rt.CoreTable(1), _rt.CoreTable(1)
    i = one.alloc("a", "t")
    assert two.find("a", "t") == i
    assert two.find("a", "u") is None
    assert [member for member, lives in two.members()] == [os.getpid()] * 2
    one.close()
    assert path.exists()
    two.close()


def test_one_rtpu_too_many_is_told_to_take_another_core(path) -> None:
    tables = [_rt.CoreTable(1) for _ in range(32)]
    said = r"too many RTPUs share this core \(expected at most 32\); .*another --core"
    with pytest.raises(NodeError, match=f"^{path}: {said}"):
        _rt.CoreTable(1)
    tables.pop().close()
    tables.append(_rt.CoreTable(1))
    for table in tables:
        table.close()


def test_a_table_whose_members_are_dead_is_stale(path) -> None:
    code = (
        "import os; from pbonet.node.rt import _rt; t = _rt.CoreTable(1);"
        "t.alloc('r', 't'); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    old = path.stat().st_ino
    orphan = _rt.CoreTable(1, member=False)
    table = _rt.CoreTable(1)
    assert path.stat().st_ino != old
    assert table.slots() == []
    assert len(orphan.slots()) == 1, "a task of the dead keeps its old table"
    orphan.close()
    table.close()


def test_slots_of_a_dead_member_are_reclaimed_by_the_next_alloc(table) -> None:
    code = (
        "import os; from pbonet.node.rt import _rt; t = _rt.CoreTable(1);"
        "[t.alloc('dead', str(k)) for k in range(127)]; os.kill(os.getpid(), 9)"
    )
    mine = table.alloc("r", "mine")
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert len(table.slots("dead")) == 127
    table.alloc("r", "another")
    assert table.slots("dead") == []
    assert mine in table.slots("r")


@pytest.mark.usefixtures("table")
@pytest.mark.parametrize(
    ("spoil", "error", "text"),
    [
        (lambda p: p.chmod(0o644), RealTimeError, "belongs to another user"),
        (lambda p: (p.unlink(), p.symlink_to("/dev/null")), RealTimeError, "another"),
        (lambda p: _poke(p, 8, b"\x63"), NodeError, "of another version"),
        (lambda p: _poke(p, 0, b"\x00"), NodeError, "is damaged; restart the agents"),
        (lambda p: os.truncate(p, 5000), NodeError, "is damaged"),
    ],
)
def test_a_file_that_is_not_right_is_refused(path, spoil, error, text) -> None:
    spoil(path)
    with pytest.raises(error, match=text):
        _rt.CoreTable(1, member=False)
    path.unlink()


@pytest.mark.usefixtures("table")
def test_another_version_with_living_members_is_refused(path) -> None:
    _poke(path, 8, b"\x63")
    with pytest.raises(
        NodeError, match=r"another version of pbonet \(expected version"
    ):
        _rt.CoreTable(1)
    _poke(path, 8, b"\x01")


def test_a_truncated_file_is_replaced_and_not_filled_again(path) -> None:
    """Else its members had a table again, in which their tasks are not."""
    code = (
        "import os, sys; from pbonet.node.rt import _rt; t = _rt.CoreTable(1);"
        "t.alloc('r', 't'); os.truncate(t.path, 0); print(flush=True); input();"
        "t.slots()"
    )
    start = [sys.executable, "-c", code]
    with subprocess.Popen(start, cwd=ROOT, stdin=-1, stdout=-1) as member:
        member.stdout.readline()
        table = _rt.CoreTable(1)
        assert table.slots() == []
        member.communicate(b"\n")
        assert member.returncode == -signal.SIGBUS
    table.close()
    assert not path.exists()


@pytest.mark.usefixtures("table")
def test_a_process_that_only_reads_may_survive_a_truncated_file(path) -> None:
    """An agent does, and a member does not."""
    code = (
        "import os; from pbonet.node.rt import _rt;"
        "from pbonet.svar import survive_cuts; survive_cuts();"
        "t = _rt.CoreTable(1, member=False); size = os.path.getsize(t.path);"
        "os.truncate(t.path, 0); print(t.slots(), t.members(), t.status().core);"
        "os.truncate(t.path, size)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True
    )
    assert done.stdout == b"[] [] 1\n"
    path.unlink()


def test_leftover_rubbish_is_replaced(path) -> None:
    path.write_bytes(b"rubbish" * 1000)
    path.chmod(0o600)
    table = _rt.CoreTable(1)
    assert table.slots() == []
    table.close()


def _poke(path: Path, at: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


@pytest.mark.mounts
def test_a_full_disk_is_said(shm) -> None:
    with mounting.tmpfs(shm, "256k"):
        with pytest.raises(RealTimeError, match=r"shared memory is full .*free space"):
            _rt.CoreTable(1)
        assert list(shm.iterdir()) == []
        with pytest.raises(RealTimeError, match=r"ring cannot be made .*No space left"):
            _rt.Ring.create("a", 1 << 20)
        assert list(shm.iterdir()) == []


def test_slots_are_given_and_taken_back(table) -> None:
    slots = [table.alloc("r", f"t{k}") for k in range(_rt.SLOTS)]
    assert sorted(slots) == list(range(_rt.SLOTS))
    with pytest.raises(NodeError, match=r"all slots .* at most 128 tasks"):
        table.alloc("r", "one more")
    table.free(slots[5])
    with pytest.raises(NodeError, match=f"slot {slots[5]} is not in use"):
        table.snapshot(slots[5])
    assert table.alloc("r", "new") == slots[5]
    assert table.snapshot(slots[5]).cycles == 0


def test_what_is_configured_is_seen(table) -> None:
    i = table.alloc("arm0", "pid")
    table.configure(i, pid=42, period_ns=2_000_000, deadline_ns=1_000_000)
    table.configure(i, crit=5, priority=9)
    got = table.snapshot(i)
    assert (got.rtpu, got.task, got.pid, got.period_ns) == (
        "arm0",
        "pid",
        42,
        2_000_000,
    )
    assert (got.deadline_ns, got.crit, got.priority) == (1_000_000, 5, 9)
    assert (got.kind, got.mode, got.dead) == (Kind.PERIODIC, Mode.OFF, False)
    table.died(i)
    assert table.snapshot(i).dead


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"period_ns": 99_999}, "period_ns 99999 is not within 100000 to"),
        ({"deadline_ns": -1}, "deadline_ns -1 is not within 0 to"),
        ({"crit": 64}, "crit 64 is not within 0 to 63"),
        ({"priority": 65536}, "priority 65536 is not within 0 to 65535"),
        ({"pid": 0}, "pid 0 is not within 1 to"),
        ({"kind": 7}, "7 is not a valid Kind"),
    ],
)
def test_settings_out_of_range_are_refused(table, settings, text) -> None:
    i = table.alloc("r", "t")
    with pytest.raises(ValueError, match=text):
        table.configure(i, **settings)


def test_the_kind_stands_while_the_task_is_armed(table) -> None:
    i = table.alloc("r", "t")
    table.post(i, mode=Mode.ON)
    with pytest.raises(ValueError, match="only while it is OFF"):
        table.configure(i, kind=Kind.SYNCHRONOUS)


def test_names_have_a_bound(table) -> None:
    with pytest.raises(NodeError, match=r"the name is too long .*at most 63 bytes"):
        table.alloc("r", "x" * 64)


@pytest.mark.usefixtures("shm")
def test_a_closed_table_says_so() -> None:
    table = _rt.CoreTable(1)
    table.close()
    with pytest.raises(NodeError, match="the core table is closed"):
        table.slots()


def test_virtual_time_is_refused_beside_a_dispatcher(table) -> None:
    dispatcher = _rt.Dispatcher(table, "park")
    dispatcher.start()
    while not dispatcher.leading:
        pass
    with pytest.raises(RealTimeError, match="a dispatcher leads this core"):
        table.step(1)
    with pytest.raises(NodeError, match="is in use; stop the dispatcher first"):
        table.close()
    assert table.status().backend == "park"
    assert table.status().leader_pid == os.getpid()
    dispatcher.stop()
    dispatcher.stop()
    assert not dispatcher.leading
    assert table.status().leader_pid == 0
    assert table.step(10**9) == 0


def test_when_a_core_stood_still_and_whether_it_does(shm) -> None:
    """Its leader is stopped by a signal, as a core is that the kernel throttles."""
    code = """
import sys
from pbonet.analysis.schedule.records import Mode
from pbonet.node.rt import _rt
table = _rt.CoreTable(1)
i = table.alloc("r", "t")
table.configure(i, period_ns=5_000_000)
table.post(i, mode=Mode.ON)
dispatcher = _rt.Dispatcher(table, "park")
dispatcher.start()
print("leads", flush=True)
sys.stdin.read()
dispatcher.stop()
"""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, "PBONET_SHM_DIR": str(shm)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as leader:
        assert leader.stdout is not None
        assert leader.stdout.readline() == b"leads\n"
        table = _rt.CoreTable(1, member=False)
        wait_for(lambda: table.status().releases > 1, "releases")
        before = table.status().stalls  # this machine may stand still at any time
        leader.send_signal(signal.SIGSTOP)
        try:
            wait_for(lambda: table.status().stall_age_ns == 0, "a stall that lasts")
        finally:
            leader.send_signal(signal.SIGCONT)
        wait_for(lambda: table.status().stalls > before, "its end")
        wait_for(lambda: table.status().stall_age_ns, "the age of the last stall")
        leader.communicate()
    assert leader.returncode == 0
    first, later = table.status().stall_age_ns, table.status().stall_age_ns
    assert 0 < first < later, "it is over, and a while ago"
    table.close()


def test_a_core_that_never_stood_still_has_no_age(table) -> None:
    assert table.status().stall_age_ns is None


def test_the_trace_tells_what_was_lost(table) -> None:
    i = table.alloc("r", "t")
    table.configure(i, period_ns=1_000_000)
    table.post(i, mode=Mode.ON)
    now = 10**9
    for _ in range(20_000):
        now = table.step(now)
        table.post(i, done=True)
    end, lost, records = table.trace()
    assert lost > 0
    assert lost + len(records) == end
    assert table.trace(end) == (end, 0, [])
    assert table.trace(end - 5)[2] == records[-5:]


def test_a_backend_has_a_name(table) -> None:
    with pytest.raises(ValueError, match="backend 'best' is not auto, fifo or park"):
        _rt.Dispatcher(table, "best")


def test_probe_says_why() -> None:
    probe = _rt.probe()
    assert probe.fifo == (probe.errno == 0)
    assert probe.backend == ("fifo" if probe.fifo else "park")
    assert probe.cores == sorted(os.sched_getaffinity(0))
    assert probe.fifo or any("SCHED_FIFO is refused" in why for why in probe.reasons)


USER = """
import sys
from pbonet.node.rt import _rt

table, present, mapped = _rt.CoreTable(1, member=False), 0, False
for line in open("/proc/self/smaps"):
    if "-" in line.split()[0]:
        mapped = line.rstrip().endswith(table.path)
    elif mapped and line.startswith("Rss:"):
        present = int(line.split()[1]) << 10
print(present)
"""


def test_a_user_has_the_slots_that_were_used_and_not_the_whole_table(path, table):
    """The rest is for the leader; each page of it would make a task start later."""

    def present():
        done = subprocess.run(
            [sys.executable, "-c", USER], cwd=ROOT, capture_output=True, check=True
        )
        return int(done.stdout)

    few = present()
    size = path.stat().st_size
    assert 0 < few < size // 4
    for number in range(64):
        table.alloc("r", f"task{number}")
    assert present() > few + size // 4


def test_a_user_touches_a_successor_before_it_calls_it(path, table):
    """The slot was not used when it opened the table; no cycle waits for its page."""

    def mapped():
        found, ours = [], False
        for line in Path("/proc/self/smaps").read_text().splitlines():
            if "-" in line.split()[0]:
                ours = line.endswith(str(path))
            elif ours and line.startswith("Rss:"):
                found.append(int(line.split()[1]))
        return min(found)  # the member has all of it

    with contextlib.closing(_rt.CoreTable(1, member=False)) as user:
        for number in range(100):
            table.alloc("r", f"task{number}")
        before, slot, ticket = mapped(), 90, 5
        life = table.expect(slot, ticket, callers=1)
        assert user.expects(slot, life, ticket, 0)
        there = mapped()
        assert there > before
        assert user.call(slot, life, ticket, 0)
        assert mapped() == there
