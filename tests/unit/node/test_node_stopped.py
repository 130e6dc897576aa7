"""Which stopped processes are continued: children, and those of others."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import textwrap

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


def test_a_stop_that_takes_the_end_of_the_parent_back_does_not_last() -> None:
    # SIGSTOP removes a SIGCONT that is still waiting, here as it is blocked.
    child = textwrap.dedent("""
        import os, signal, time
        from pbonet.node.wire import process_setup
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCONT})
        parent = os.getppid()
        process_setup.on_end_of_parent(parent, always=True)
        print(os.getpid(), flush=True)
        while os.getppid() == parent:
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGSTOP)
        print("goes on", flush=True)
    """)
    code = f"import subprocess, sys; subprocess.call([sys.executable, '-c', {child!r}])"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as parent:
        pid = int(parent.stdout.readline())
        parent.kill()
        try:
            assert parent.stdout.readline() == "goes on\n"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def test_the_fork_server_continues_an_rtpu_process_that_stops_with_its_agent() -> None:
    """It alone can: the stop has taken back what the kernel had sent."""
    rtpu = textwrap.dedent("""
        import os, signal, socket, time
        from pbonet.node.task import fork_server
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        agent, rtpu = os.getppid(), os.getpid()
        if os.fork() == 0:
            near.close()
            os._exit(fork_server.serve(far, rtpu, 0))
        far.close()
        near.recv(100)
        print(rtpu, flush=True)
        while os.getppid() == agent:
            time.sleep(0.001)
        os.kill(rtpu, signal.SIGSTOP)
        print("goes on", flush=True)
    """)
    code = f"import subprocess, sys; subprocess.call([sys.executable, '-c', {rtpu!r}])"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as agent:
        pid = int(agent.stdout.readline())
        agent.kill()
        try:
            assert agent.stdout.readline() == "goes on\n"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
