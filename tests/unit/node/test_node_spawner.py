"""The RTPU process's hold on a child that was forked for it."""

import asyncio
import errno
import gc
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from watching import wait_for

from pbonet.errors import NodeError
from pbonet.node.rtpu.fork_client import Child, Server, Spawner
from pbonet.node.task import fork_server, spare_process
from pbonet.node.wire.process_setup import ORPHANED


@pytest.fixture(autouse=True)
def _no_garbage():
    """Close the files of earlier tests, because these tests count files."""
    gc.collect()


def test_a_child_that_is_gone_before_it_is_held():
    """It may end, and be reaped, before the news of its fork is read."""
    done = subprocess.Popen([sys.executable, "-I", "-S", "-c", ""])
    done.wait()

    async def hold():
        near, far = socket.socketpair()
        far.close()
        files = [os.memfd_create(name) for name in ("out", "crash", "spec")]
        child = Child(done.pid, near, *files)
        child.send_signal(signal.SIGTERM)
        assert (child.started, child.crash_text()) == (0, "")
        child.close()

    before = sorted(Path("/proc/self/fd").iterdir())
    asyncio.run(hold())
    assert sorted(Path("/proc/self/fd").iterdir()) == before


def child_of(process):
    near, far = socket.socketpair()
    far.close()
    return Child(process.pid, near, *(os.memfd_create(x) for x in ("o", "c", "s")))


def test_children_that_outlive_the_fork_server_are_watched():
    sleeper = [sys.executable, "-I", "-S", "-c", "input()"]
    forks = subprocess.Popen([sys.executable, "-I", "-S", "-c", ""])
    processes = [subprocess.Popen(sleeper, stdin=subprocess.PIPE) for _ in range(3)]

    async def outlive():
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        told = asyncio.get_running_loop().create_future()
        spawner = Spawner(0, Server(forks.pid, near), told.set_result)
        far.send(b"ready")
        await spawner.start()
        children = [child_of(one) for one in processes]
        spawner._children = {one.pid: one for one in children}
        for one in children:
            one.watch(spawner._ended)
        far.close()
        assert await asyncio.wait_for(told, 30.0) == 0
        assert not any(one.exited.done() for one in children)
        for process in processes:
            process.communicate(b"")
        codes = asyncio.gather(*(one.exited for one in children))
        assert await asyncio.wait_for(codes, 30.0) == [ORPHANED] * 3
        for child in children:
            child.close()
        await spawner.close()

    asyncio.run(outlive())
    forks.poll()  # it was reaped


def test_a_system_that_gives_no_process_is_named(monkeypatch):
    def refused():
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(os, "fork", refused)
    before = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(NodeError, match=r"cannot create a process .*Resource.*ulimit"):
        fork_server.beside(0, close=-1)
    assert sorted(Path("/proc/self/fd").iterdir()) == before


@pytest.fixture
def spare(monkeypatch):
    """Give a spare that becomes 7 if it has a task's files and score, else 1."""
    monkeypatch.setattr(spare_process, "_copy_memory", lambda: None)
    score = Path("/proc/self/oom_score_adj")
    before = score.read_text()

    def become(data, fds, _server):
        alone = [*Path("/proc/self/fd").iterdir()]  # and the folder that is read
        is_task = score.read_text() == before and len(alone) == 3 + len(fds) + 1
        return 7 if is_task and data == b"a request" else 1

    made = spare_process.SpareProcess(fork_server.receive_with_fds, become)
    yield made
    made.drop()


def used(spare):
    """Hand a spare a request; return whether there was one that took it."""
    with open(os.devnull, "rb") as null:  # noqa: PTH123
        pid = spare.use(b"a request", [null.fileno()] * fork_server.FDS)
    return pid and os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_a_spare_does_not_yield_where_it_could_not_return(spare, monkeypatch):
    """As in a user namespace; a task must not stay behind all other processes."""

    idle = set()

    def refuses(pid, policy, _param):
        if policy != os.SCHED_IDLE:
            raise PermissionError(errno.EPERM, "refused")
        idle.add(pid)

    monkeypatch.setattr(os, "sched_setscheduler", refuses)
    spare.prepare()
    assert idle
    assert spare.pid not in idle
    assert used(spare)


@pytest.mark.parametrize("lacking", ["fork", "socketpair"])
def test_a_spare_that_cannot_be_made_is_left_out(spare, monkeypatch, lacking):
    def refuses(*_):
        raise OSError(errno.EMFILE, "no more")

    monkeypatch.setattr(socket if lacking == "socketpair" else os, lacking, refuses)
    spare.prepare()
    assert not used(spare)


def test_a_spare_is_ended_first_when_memory_is_short(spare):
    spare.prepare()
    score = Path(f"/proc/{spare.pid}/oom_score_adj")
    wait_for(lambda: score.read_text() == "1000\n", "its score")
    assert used(spare)
