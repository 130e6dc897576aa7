"""Less than everything: shared memory that is full, no real-time rights, no root."""

import ctypes
import os
import resource
import subprocess
import sys
from pathlib import Path

import mounting
import pytest

from pbonet.errors import PbonetError, RealTimeError, SvarFullError
from pbonet.node.agent.agent import Agent
from pbonet.node.rt import _rt
from pbonet.node.wire import cpu_idle_states
from pbonet.xm.net import messages as m

PR_CAPBSET_DROP = 24
CAPABILITIES = (14, 23, 24)
"""IPC_LOCK, SYS_NICE, SYS_RESOURCE: what root has more than a user, for real time."""


@pytest.fixture
def small(shared_memory, monkeypatch):
    """A shared memory with room for little, as a file system of its own."""
    folder = shared_memory / "small"
    folder.mkdir()
    with mounting.tmpfs(folder, "6m"):
        monkeypatch.setenv("PBONET_SHM_DIR", str(folder))
        yield folder
    folder.rmdir()


def fill(folder, spare):
    """Leave `spare` bytes in a file system."""
    path = folder / "filler"
    path.unlink(missing_ok=True)
    room = os.statvfs(folder)
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, room.f_bavail * room.f_bsize - spare)
    return path


@pytest.mark.mounts
def test_full_shared_memory(small, nodes):
    """Whatever finds no room says so, and works when there is."""
    filler = fill(small, 4096)
    with pytest.raises(RealTimeError) as caught:
        Agent(nodes.config("arm0")).start()
    assert "space" in str(caught.value)
    filler.unlink()
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", table=False)
    filler = fill(small, 4096)
    error = arm.refused(SvarFullError, arm.open_table)
    assert "no room for the table" in error.what
    filler.unlink()
    arm.open_table()
    arm.spawn("good", "counts", out="Y0")
    arm.on("good")
    filler = fill(small, 8192)
    with pytest.raises(PbonetError) as caught:
        arm.spawn("a", "counts", out="Y1")
    assert "space" in str(caught.value)
    assert set(arm.status()) == {"good"}
    arm.wait_cycles("good", 10)
    filler.unlink()
    assert arm.spawn("a", "counts", out="Y1").state == "OFF"
    arm.stop()


def test_park_back_end(nodes):
    """Without real-time rights everything works, and is said to be soft."""
    nodes.agent("arm0", backend="park")
    arm = nodes.master("arm0", "arm")
    assert arm.client.call("arm0", m.Hello(), m.AgentInfo).backend == "park"
    for i in range(3):
        arm.spawn(f"t{i}", "counts", out=f"Y{i}", freq=50.0)
        arm.on(f"t{i}")
    for i in range(3):
        arm.wait_cycles(f"t{i}", 20)
    assert arm.stop().killed == []


def test_fifo_is_refused_where_it_cannot_be_had(nodes):
    if _rt.probe().fifo:
        pytest.skip("this process has the right to SCHED_FIFO")
    with pytest.raises(RealTimeError):
        Agent(nodes.config("arm0"), backend="fifo").start()


def test_life_without_rights(nodes):
    """What an ordinary user gets; as root it runs in the test below too."""
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    info = arm.client.call("arm0", m.Hello(), m.AgentInfo)
    assert info.backend == _rt.probe().backend
    assert (info.limits == []) or all(len(text) > 20 for text in info.limits)
    if info.backend == "park":
        assert any("SCHED_FIFO" in text for text in info.limits)
    arm.spawn("a", "counts", freq=50.0)
    arm.spawn("bad", "segfaults", out="Y1", freq=50.0)
    arm.on("a")
    arm.on("bad")
    arm.wait_event("TASK_DIED", "bad")
    arm.wait_cycles("a", 10)
    assert arm.off("a").state == "OFF"
    assert arm.kill("a").state == "NOT-CREATED"


@pytest.mark.parametrize("awake", [True, False])
def test_processors_are_kept_awake_where_that_is_asked(nodes, awake):
    """By the RTPU process as long as it lives, or it says why not."""
    agent = nodes.agent("arm0", awake=awake)
    fds = Path(f"/proc/{agent.info().rtpu_pid}/fd")
    held = any(fd.resolve() == cpu_idle_states.DEVICE for fd in fds.iterdir())
    told = any("processors sleep" in text for text in agent.info().limits)
    assert held + told == awake


def test_as_root_without_its_rights():
    """Root in many a container: no capability to schedule or lock, and no limits."""
    if os.getuid() != 0:
        pytest.skip("every test here runs as an ordinary user already")
    only = "life_without_rights or fifo_is_refused"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            __file__,
            "-k",
            only,
        ],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=give_up_rights,
    )
    assert "2 passed" in done.stdout, done.stdout + done.stderr


def give_up_rights():
    """Take from the process to come what real time needs."""
    libc = ctypes.CDLL(None)
    for capability in CAPABILITIES:
        libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 16, 1 << 16))
