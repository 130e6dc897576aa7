"""Cleaning up behind an RTPU process that was killed."""

import contextlib
import os
import signal
import subprocess
import sys
import threading

import pytest

from pbonet import shm
from pbonet.config.model import Variable
from pbonet.node.rtpu import cleanup, sbs_server
from pbonet.node.wire import process_setup
from pbonet.svar import Table
from pbonet.xm.net import run_folder

HOLDS = """
import sys
from pbonet.svar import Table
table = Table.attach("d.arm")
print(flush=True)
sys.stdin.read()
"""


@pytest.fixture
def holder():
    """A process that has the table d.arm open, as a task has."""
    with Table.create("d.arm", [Variable(name="V", type="double", nelem=1)]):
        process = subprocess.Popen(
            [sys.executable, "-c", HOLDS],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        process.stdout.readline()
    with process:
        yield process


def test_a_table_is_removed_though_a_task_takes_its_time_to_die(
    run_dir, shared_memory, holder, monkeypatch
):
    """It was killed, and the machine stands still before it is gone."""
    assert run_dir.is_dir()
    places = run_folder.Places("d", "arm0")
    task = cleanup.TaskLeft(holder.pid, process_setup.start_time(holder.pid))
    dead = cleanup.Leftovers(pid=2**22 - 1, started=1, core=0, tables=["d.arm"])
    dead.tasks = [task]
    cleanup.write(places.state, dead)
    kill, killers = os.kill, []

    def later(pid, which):
        assert which == signal.SIGKILL
        killers.append(threading.Timer(0.3, kill, (pid, which)))
        killers[-1].start()

    with contextlib.ExitStack() as after:
        after.callback(lambda: [one.join() for one in killers])
        monkeypatch.setattr(cleanup.os, "kill", later)
        done = cleanup.clean(places, patience=0.0)
    assert done == [
        f"process {holder.pid} did not end and was killed",
        "table d.arm was removed",
    ]
    assert list(shared_memory.glob("*.svar")) == []


@pytest.mark.parametrize("step", ["sweep_claims", "tbuf.sweep"])
def test_the_files_go_though_another_step_of_the_end_fails(
    run_dir, shared_memory, monkeypatch, step
):
    assert run_dir.is_dir()
    assert shared_memory.is_dir()
    places = run_folder.Places("d", "arm0")
    for path in (places.ctl, places.state, places.log, *places.agents_files):
        path.touch()

    def fails(*_):
        raise OSError("something else removes it at this moment")

    where = sbs_server.cleanup if step == "sweep_claims" else sbs_server.tbuf
    monkeypatch.setattr(where, step.rpartition(".")[2], fails)
    with pytest.raises(OSError, match="at this moment"):
        sbs_server.clean_up(places)
    assert list(places.folder.iterdir()) == []


@pytest.mark.parametrize("content", [b"", bytes(100)])
def test_the_ring_of_a_task_that_was_being_made_is_removed(
    run_dir, shared_memory, content
):
    """Task and RTPU process were killed before the one had told the other."""
    assert run_dir.is_dir()
    places = run_folder.Places("d", "arm0")
    ring = shm.path_of("d.arm.a.ring")
    ring.write_bytes(content)
    dead = cleanup.Leftovers(pid=2**22 - 1, started=1, core=0, rings=["d.arm.a"])
    cleanup.write(places.state, dead)
    assert "ring d.arm.a was removed" in cleanup.clean(places)
    ring.write_bytes(content)
    sbs_server.clean_up(places, rings=["d.arm.a", "d.arm.none"])
    assert list(shared_memory.iterdir()) == []
