"""The RTPU process's hold on a child that was forked for it."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

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
