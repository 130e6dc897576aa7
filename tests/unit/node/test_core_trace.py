"""Who had a core: the kernel's text, and the files by which it is asked for."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from collections import deque

import pytest
from msgspec import Struct

from pbonet.errors import RealTimeError
from pbonet.node.wire import core_trace
from pbonet.node.wire.core_trace import SwitchTrace, Window, first_miss, switches, uses

TEXT = """# tracer: nop
#
#           TASK-PID     CPU#  |||||  TIMESTAMP  FUNCTION
          <idle>-0       [001] d..2.   100.000000: sched_switch: prev_comm=swapper/1 \
prev_pid=0 prev_prio=120 prev_state=R ==> next_comm=vision one next_pid=7 next_prio=19
      vision one-7       [001] d..2.   100.004000: sched_switch: prev_comm=vision one \
prev_pid=7 prev_prio=19 prev_state=S ==> next_comm=kworker/1:2 next_pid=77 next_prio=120
     kworker/1:2-77      [001] d..2.   100.005000: sched_switch: prev_comm=kworker/1:2 \
prev_pid=77 prev_prio=120 prev_state=I ==> next_comm=pid next_pid=9 next_prio=20
             pid-9       [001] d..2.   100.006500: sched_switch: prev_comm=pid \
prev_pid=9 prev_prio=20 prev_state=S ==> next_comm=swapper/1 next_pid=0 next_prio=120
"""


def test_the_kernels_text_is_read_with_names_that_have_spaces():
    found = [*switches(TEXT)]
    assert [one.at for one in found] == [100.0, 100.004, 100.005, 100.0065]
    assert found[1] == (100.004, 7, 77, "vision one")
    assert [*switches("nothing\n\n")] == []
    (other,) = switches(TEXT.split("\n")[4].replace("vision one", "\x1b[2J\x0bx"))
    assert other.name == "?[2J?x", "any user may choose it"


@pytest.mark.parametrize(
    ("begin", "end", "expected"),
    [
        (100.001, 100.006, {7: 3, 77: 1, 9: 1}),
        (99.0, 100.002, {0: 1000, 7: 2}),
        (100.006, 100.010, {9: 0.5, 0: 3.5}),
        (101.0, 102.0, {0: 1000}),
        (100.0045, 100.0048, {77: 0.3}),
    ],
)
def test_each_thread_has_the_time_within_the_interval(begin, end, expected):
    """All of it adds up, also where no change lies in it."""
    found = uses([*switches(TEXT)], begin, end)
    told = {pid: seconds * 1e3 for pid, seconds in found.items()}
    assert told == pytest.approx(expected)
    assert sum(found.values()) == pytest.approx(end - begin)
    assert uses([], begin, end) == {}


@pytest.fixture
def tracefs(tmp_path, monkeypatch):
    """A folder that stands for tracefs: a new instance has its files at once."""
    root = tmp_path / "tracing"
    (root / "instances").mkdir(parents=True)
    made = type(root).mkdir

    def mkdir(self, *args, **kwargs):
        made(self, *args, **kwargs)
        if self.parent == root / "instances":
            for name in ("per_cpu/cpu40", "events/sched/sched_switch"):
                made(self / name, parents=True)
            (self / "per_cpu/cpu40/trace").write_text(TEXT)
            (self / "tracing_on").write_text("1")

    monkeypatch.setattr(type(root), "mkdir", mkdir)
    return root


def test_the_event_is_on_for_one_core_until_it_is_stopped(tracefs, monkeypatch):
    removed = []
    monkeypatch.setattr(
        core_trace, "_removed", lambda folder: removed.append(folder.name)
    )
    trace = SwitchTrace(40, [tracefs.parent / "nowhere", tracefs])
    trace.start()
    mine = tracefs / "instances" / f"pbonet-{os.getpid()}"
    written = {
        str(path.relative_to(mine)): path.read_text()
        for path in mine.rglob("*")
        if path.is_file() and path.name != "trace"
    }
    assert written == {
        "per_cpu/cpu40/buffer_size_kb": "4096",
        "trace_clock": "mono",
        "tracing_on": "1",
        "tracing_cpumask": "00000100,00000000",
        "events/sched/sched_switch/enable": "1",
    }
    assert len(trace.stop()) == 4
    assert (mine / "tracing_on").read_text() == "0"
    assert removed == [mine.name]
    assert trace.stop() == []


def test_a_tracefs_that_only_root_may_read_is_no_fault(tmp_path, monkeypatch):
    """So it is for an agent of another user: it starts, and says why it cannot."""

    def refuse(self, **_):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    with monkeypatch.context() as patch:
        for name in ("stat", "mkdir"):
            patch.setattr(type(tmp_path), name, refuse)
        assert core_trace.sweep([tmp_path]) == []
        with pytest.raises(RealTimeError, match=r"cannot be followed .*Permission"):
            SwitchTrace(0, [tmp_path]).start()


def test_without_tracefs_it_is_said_with_what_to_do(tmp_path):
    with pytest.raises(
        RealTimeError, match=r"sched_switch cannot be followed .*no tracefs is mounted"
    ) as refused:
        SwitchTrace(0, [tmp_path]).start()
    assert "run the agent as root" in refused.value.remedy
    (tmp_path / "instances").write_text("a file")
    with pytest.raises(RealTimeError):
        SwitchTrace(0, [tmp_path]).start()


class Slot(Struct):
    """What is read of a task's entry in the core table."""

    release_ns: int
    missed: int
    failed: int = 0
    on_ns: int = 1
    now_ns: int = 100_000_000
    period_ns: int = 10_000_000


@pytest.mark.parametrize(
    ("slots", "expected"),
    [
        ([Slot(0, 0), Slot(10**7, 0), Slot(3 * 10**7, 1)], (1, 10**7, 5 * 10**7)),
        ([Slot(0, 2), Slot(10**7, 3)], (1, 10**7, 3 * 10**7)),
        ([Slot(0, 2), Slot(0, 3, now_ns=10**7)], (1, 0, 10**7)),
        ([Slot(0, 5), Slot(0, 0, 0, 2), Slot(0, 2, 0, 2)], (2, 0, 3 * 10**7)),
        ([Slot(0, 0), Slot(10**7, 1, 1), Slot(10**7, 2, 1)], (1, 10**7, 3 * 10**7)),
    ],
)
def test_a_miss_is_seen_with_the_releases_around_it(slots, expected):
    """One that was turned on again counts anew; a cycle that failed is none."""
    left = deque(slots)
    look = left.popleft
    assert first_miss(look, 30.0) == Window(*expected)


@pytest.fixture
def mounted(tmp_path):
    """The kernel's own tracefs."""
    done = subprocess.run(
        ["mount", "-t", "tracefs", "none", tmp_path], capture_output=True, check=False
    )
    if done.returncode:
        pytest.skip("mounting tracefs needs root, and a kernel that has it")
    yield tmp_path
    subprocess.run(["umount", tmp_path], check=True)


def test_the_kernel_says_who_had_a_core(mounted):
    """A process that comes and goes on a core is seen there, and nothing is left."""
    core = max(os.sched_getaffinity(0))
    trace = SwitchTrace(core, [mounted])
    code = "import time\nfor _ in range(20): time.sleep(0.001)"
    trace.start()
    begin = time.monotonic()
    with subprocess.Popen([
        "taskset",
        "-c",
        str(core),
        sys.executable,
        "-c",
        code,
    ]) as p:
        p.wait()
    end = time.monotonic()
    found = uses(trace.stop(), begin, end)
    assert 0 < found[p.pid] < end - begin
    assert sum(found.values()) == pytest.approx(end - begin)
    assert not [*mounted.glob("instances/pbonet-*")]


def test_what_a_killed_process_followed_is_removed_and_nothing_else(mounted):
    """Its files were closed by the kernel; a process that lives holds one open."""
    (mounted / "instances/another").mkdir()
    code = (
        "import pathlib, sys, time\n"
        "from pbonet.node.wire.core_trace import SwitchTrace\n"
        "trace = SwitchTrace(0, [pathlib.Path(sys.argv[1])])\n"
        "trace.start()\n"
        "print('followed', flush=True)\n"
        "time.sleep(60)\n"
    )
    words = [sys.executable, "-c", code, str(mounted)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"followed\n"
        name = f"pbonet-{process.pid}"
        event = mounted / "instances" / name / "events/sched/sched_switch/enable"
        assert event.read_text() == "1\n"
        assert core_trace.sweep([mounted]) == []
        assert event.read_text() == "1\n"
        process.kill()
        process.wait()
        assert core_trace.sweep([mounted]) == [name]
    left = [one.name for one in mounted.glob("instances/*")]
    (mounted / "instances/another").rmdir()
    assert left == ["another"]


def test_no_miss_within_the_time():
    assert first_miss(lambda: Slot(0, 3), 0.01) is None
