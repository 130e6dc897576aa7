"""The RTPU process's hold on a child that was forked for it."""

import asyncio
import errno
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.errors import NodeError
from pbonet.node import forkserver
from pbonet.node.spawner import Child


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


def test_a_system_that_gives_no_process_is_named(monkeypatch):
    def refused():
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(os, "fork", refused)
    before = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(NodeError, match=r"gives no process .*Resource.*ulimit"):
        forkserver.beside(0, close=-1)
    assert sorted(Path("/proc/self/fd").iterdir()) == before
