"""Which stopped processes are continued: children, and those of others."""

from __future__ import annotations

import os
import signal
import subprocess

import pytest
from watching import wait_for

from pbonet.node.wire import process_setup

WAITS = "sleep 60 & echo $!; wait"


@pytest.fixture
def child():
    """A shell, and the process that it has started."""
    shell = subprocess.Popen(
        ["/bin/sh", "-c", WAITS], stdout=subprocess.PIPE, text=True
    )
    grandchild = int(shell.stdout.readline())
    yield shell.pid, grandchild
    os.kill(grandchild, signal.SIGKILL)
    shell.kill()
    shell.communicate()


@pytest.mark.parametrize("which", [0, 1], ids=["a child", "no child"])
def test_a_stopped_process_is_continued_once(child, which) -> None:
    pid = child[which]
    assert not process_setup.resume(pid)
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: process_setup.stat(pid).state == "T", "the stop")
    assert process_setup.resume(pid)
    wait_for(lambda: process_setup.stat(pid).state == "S", "that it runs again")
    assert not process_setup.resume(pid)


def test_what_has_ended_is_not_stopped() -> None:
    with subprocess.Popen(["/bin/true"]) as ended:
        pass
    assert not process_setup.resume(ended.pid)
