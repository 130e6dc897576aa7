"""What a process sets up for itself, seen in the kernel's own words."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pbonet.node.rt import _rt
from pbonet.node.wire import process_setup

ROOT = Path(__file__).parents[3]


def python(code: str, **more: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", "from pbonet.node.rt import _rt\n" + code],
        cwd=ROOT,
        env={**os.environ, **more},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_timer_slack() -> None:
    code = "_rt.set_timer_slack(1); print(open('/proc/self/timerslack_ns').read())"
    assert python(code).split() == ["1"]


def test_pin() -> None:
    core = max(os.sched_getaffinity(0))
    code = f"import os; _rt.pin({core}); print(os.sched_getaffinity(0))"
    assert python(code).strip() == f"{{{core}}}"


@pytest.mark.skipif(
    not _rt.probe().lock_memory, reason="the memlock limit is too small"
)
def test_memory_is_locked_as_it_is_touched() -> None:
    code = """
_rt.lock_memory()
status = open('/proc/self/status').read().splitlines()
print([line.split()[1] for line in status if line.startswith(('VmLck', 'VmRSS'))])
"""
    locked, resident = (int(kb) for kb in eval(python(code)))  # noqa: S307 - ours
    assert locked > 0
    assert resident < 200_000, "the whole address space was made present"


COUNTED = """
import mmap, os, resource

def area(size):
    found = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    found.madvise(mmap.MADV_NOHUGEPAGE)
    return found

def own():
    with open("/proc/self/smaps_rollup") as file:
        return sum(int(l.split()[1]) << 10 for l in file if l.startswith("Private_D"))

def faults(data, start, end):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for at in range(start, end, mmap.PAGESIZE):
        data[at] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
"""


def test_what_a_fork_shares_stays_shared_and_the_rest_is_made_present() -> None:
    """A page of the parent is copied when it is written, and no earlier."""
    code = """
half = 7 << 20
data = area(2 * half)
data[:half] = b'x' * half
pid = os.fork()
if pid:
    os._exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
before, at = own(), ctypes.addressof(ctypes.c_char.from_buffer(data))
made = _rt.populate_pages([(at, at + (1 << 20))])
print(made, own() - before, faults(data, half, 2 * half), faults(data, 0, 1 << 20),
      faults(data, 1 << 20, half), half, flush=True)
os._exit(0)
"""
    found = python("import ctypes\n" + COUNTED + code).split()
    made, grown, absent, copied, shared, half = (int(number) for number in found)
    assert made >= half
    assert half <= grown < half * 1.7
    assert absent < 100
    assert copied < 10
    assert shared >= (half - (1 << 20)) // 4096


def test_a_task_copies_the_code_that_runs_it_before_its_first_cycle() -> None:
    """Else its first timing failure and its first exception would wait for that."""
    code = """
from pbonet.node.task import code_pages, deliver_timing_failure, executor, fork_server
classes = executor.Executor, deliver_timing_failure.TimingFailureDelivery
codes = [one.__code__ for cls in classes for one in vars(cls).values()
         if hasattr(one, "__code__")]
fork_server.share_objects()
for pages in ((), code_pages.code_pages()):
    pid = os.fork()
    if not pid:
        _rt.populate_pages(pages)
        taken = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        others, before = [0] * len(codes), [taken(), taken()][1]
        others.extend(codes)  # counts a reference to each
        print(taken() - before, flush=True)
        os._exit(0)
    os.waitpid(pid, 0)
"""
    shared, copied = (int(number) for number in python(COUNTED + code).split())
    assert shared > 8
    assert copied < shared // 3


def test_a_task_finds_loaded_what_modules_share() -> None:
    """Each task would load it again, and search the same folders."""
    code = """
import os, sys
from pbonet.config import Library
from pbonet.node.task import task_process
task_process.Prepared()
before, scandir, seen = {*sys.modules}, os.scandir, []
os.scandir = lambda path: seen.append(path) or scandir(path)
Library().load("sine")
print(len(seen), *sorted(sys.modules.keys() - before))
"""
    place = "pbonet.modules.trajectories"
    assert python(code).split() == ["0", place, f"{place}.sine"]


CHANGED = """
import os, socket, sys
from pathlib import Path
from pbonet.config import library
from pbonet.node.task import fork_server, task_process
shelf = Path(sys.path[0], "shelf")
library.BUILT_IN, library._COMMON = "shelf", "shelf._values"

def child(*_):
    names = [one.folder.name for one in library.built_in()]
    there = "shelf._values" in sys.modules
    from shelf import _values
    print(there, _values.N, *names, flush=True)
    return 0

fork_server.become_child = child
server = fork_server.ForkServer(socket.socket(), task_process.Prepared())
for change in (lambda: None, {change}):
    change()
    server._fork(None, [])
    os.wait()
"""


@pytest.mark.parametrize(
    ("change", "first", "later"),
    [
        ("lambda: None", "True 1 shelf arms", "True 1 shelf arms"),
        (
            "lambda: (shelf / '_values.py').write_text('N = 20')",
            "True 1 shelf arms",
            "False 20 shelf arms",
        ),
        (
            "lambda: (shelf / 'arms').rename(shelf / 'hands')",
            "True 1 shelf arms",
            "False 1 shelf hands",
        ),
    ],
)
def test_what_changes_on_disk_is_read_again_by_tasks(
    tmp_path, change, first, later
) -> None:
    """The text that runs is the one whose hash is recorded."""
    (tmp_path / "shelf" / "arms").mkdir(parents=True)
    for name in ("__init__.py", "arms/__init__.py", "_values.py"):
        (tmp_path / "shelf" / name).write_text("N = 1\n")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    code += CHANGED.replace("{change}", change)
    done = python(code, PYTHONDONTWRITEBYTECODE="1")
    assert done.splitlines() == [first, later]


@pytest.mark.parametrize("text", ["1 / 0", None])
def test_what_is_broken_on_disk_ends_no_fork_server(tmp_path, text) -> None:
    """Tasks whose module needs it report it."""
    (tmp_path / "shelf").mkdir()
    (tmp_path / "shelf" / "__init__.py").touch()
    if text:
        (tmp_path / "shelf" / "_values.py").write_text(text)
    code = f"""
import sys; sys.path.insert(0, {str(tmp_path)!r})
from pbonet.config import library
from pbonet.node.task import task_process
library.BUILT_IN, library._COMMON = "shelf", "shelf._values"
task_process.Prepared().check()
print("serves")
"""
    assert python(code).split() == ["serves"]


def test_a_large_buffer_of_which_little_is_used_stays_small() -> None:
    """OpenBLAS has one in each process."""
    code = """
data = area(64 << 20)
data[:1 << 20] = b'x' * (1 << 20)
before = own()
_rt.populate_pages()
print(own() - before)
"""
    assert int(python(COUNTED + code)) < 16 << 20


def test_temporaries_of_a_cycle_have_room_that_is_present() -> None:
    code = """
_rt.populate_pages()
print(faults(bytearray(900_000), 0, 900_000))
"""
    assert int(python(COUNTED + code, **process_setup.EXEC_ENVIRONMENT)) < 10


def test_the_stack_is_touched_down_to_the_depth_asked_for() -> None:
    code = """
import resource
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
_rt.prefault_stack(1 << 20)
between = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
_rt.prefault_stack(1 << 20)
print(between - before, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - between)
"""
    first, second = (int(n) for n in python(code).split())
    assert first >= 200
    assert second < 10


def test_clocks() -> None:
    assert abs(_rt.monotonic_ns() - time.monotonic_ns()) < 10**9
    before = _rt.thread_cpu_ns()
    while _rt.thread_cpu_ns() - before < 10**6:
        pass


def test_an_orphan_without_a_slot_is_told_and_then_ended() -> None:
    """The middle process dies; its child sees the descriptor and ends by the alarm.

    A copy of the child watches the descriptor, which both share: the child itself may
    not get a core before its alarm.
    """
    code = """
import os, select, signal
reader, writer = os.pipe()
middle = os.fork()
if middle == 0:
    pid = os.getpid()
    if os.fork() == 0:
        fd = _rt.orphan_guard(signal.SIGUSR1, pid)
        if os.fork() == 0:
            os.write(writer, b'ready ')
            select.select([fd], [], [])
            os.write(writer, b'told ')
            os._exit(0)
        while True:
            pass
    os.read(reader, 6)
    os._exit(0)
os.waitpid(middle, 0)
os.close(writer)
said = b''
while data := os.read(reader, 100):  # until the child has gone
    said += data
print(said.decode())
"""
    assert python(code).strip() == "told"


def test_a_parent_that_is_gone_already_is_noticed() -> None:
    code = "_rt.orphan_guard(10, 999999); print(_rt.orphaned())"
    assert python(code).strip() == "True"


def test_the_guard_refuses_what_is_no_signal() -> None:
    with pytest.raises(OSError, match="the parent process cannot be watched"):
        _rt.orphan_guard(signal.SIGKILL)


CHILDREN = """
import os, signal, subprocess
from pathlib import Path
from pbonet.node.wire import process_setup
process_setup.adopt_descendants()
lives = subprocess.Popen(["sleep", "60"])
ended = subprocess.Popen(["true"])
os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
forks = subprocess.Popen(
    ["sh", "-c", "sleep 60 >&2 & echo $!"], stdout=subprocess.PIPE, text=True
)
adopted = int(forks.stdout.read())
forks.wait()
{how}
found = process_setup.own_children()
for pid in (lives.pid, adopted):
    os.kill(pid, signal.SIGKILL)
print(sorted(found) == sorted([lives.pid, ended.pid, adopted]))
"""


@pytest.mark.parametrize("listed", [True, False])
def test_own_children_are_also_ended_and_adopted_ones(listed: bool) -> None:
    """With the list of the kernel, and without it by the state of all processes."""
    if listed and not Path("/proc/thread-self/children").exists():
        pytest.skip("this kernel was made without CONFIG_PROC_CHILDREN")
    without = "process_setup._OWN_CHILDREN = Path('/proc/none')"
    how = "process_setup.children = None  # not called" if listed else without
    assert python(CHILDREN.format(how=how)).strip() == "True"
