"""What may happen to an RTPU: its clock is set, its core taken, its rights are gone."""

import mmap
import os
import shutil
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from nodekit import CORE, rmod
from reference import Reference
from watching import wait_for

from pbonet.errors import Severity
from pbonet.node.rt import _rt

NATIVE = Path(__file__).parents[2] / "native"
ABOVE = 85
"""A level of SCHED_FIFO above all tasks."""
HOUR = 3600
NOBODY = 65534
GIVES_UP = f"""
import os, signal, sys
def turn(*_):
    os.seteuid(0 if os.geteuid() else {NOBODY})
if "pbonet.node.rtpu.rtpu_process" in sys.orig_argv:
    signal.signal(signal.SIGUSR2, turn)
"""
"""Run at the start of each Python: an RTPU process that loses its rights when told."""

needs_fifo = pytest.mark.skipif(
    not _rt.probe().fifo, reason="SCHED_FIFO is refused here"
)


@pytest.fixture
def time_of_day(tmp_path, monkeypatch):
    """Return a function that sets the clock for processes started from here on."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to make the shim with")
    shim, told = tmp_path / "clock_jumps.so", tmp_path / "jump"
    source = str(NATIVE / "clock_jumps.c")
    flags = ["-std=c11", "-Wall", "-Werror", "-O1", "-fPIC", "-shared"]
    subprocess.run([compiler, *flags, "-o", str(shim), source, "-ldl"], check=True)
    told.write_bytes(bytes(8))
    monkeypatch.setenv("LD_PRELOAD", str(shim))
    monkeypatch.setenv("CLOCK_JUMPS", str(told))
    with told.open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared:
        yield lambda seconds: struct.pack_into("q", shared, 0, seconds)


def test_setting_the_clock_moves_no_release(nodes, time_of_day):
    """The time of day jumps by hours, to and fro, while a task runs."""
    nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("t", "counts", out="Y0", freq=100.0)
    arm.on("t")
    arm.wait_cycles("t", 5)
    with Reference(CORE, ABOVE) as reference:
        before = arm.status("t")
        for hours in (1, -2, 48, 0):
            time_of_day(hours * HOUR)
            arm.wait_cycles("t", 20)
            assert 0.0 <= arm.value("Y0").age < 10.0
        after = arm.status("t")
        lost = reference.lost(100.0)
    assert after.miss - before.miss <= lost
    periods = (after.now - before.now) * 1e-9 * 100.0
    done = after.cycle - before.cycle + after.miss - before.miss
    assert done == pytest.approx(periods, abs=2 + lost)
    time_of_day(5 * HOUR)  # the shim works: events are dated by the clock on the wall
    arm.spawn("u", "counts", out="Y1", freq=100.0)
    first, last = arm.wait_event("SPAWNED", "t"), arm.wait_event("SPAWNED", "u")
    assert last.wall - first.wall > 4 * HOUR
    assert (last.time - first.time) * 1e-9 < HOUR
    time_of_day(0)


@needs_fifo
def test_a_throttled_core_is_told(arm):
    """Real-time load of a whole core for seconds: the kernel gives others a share."""
    text = rmod("soft", out="Y1", freq=0.25, local={"PLAN": "3.2"})
    arm.spawn("greedy", "soft", text=text, crit=2)
    arm.spawn("t", "counts", out="Y0", freq=200.0, crit=5)
    arm.on("t")
    starved = subprocess.Popen(
        [sys.executable, "-c", f"import os; os.sched_setaffinity(0, {{{CORE}}})\n"
         "while True: pass"]
    )  # fmt: skip
    try:
        with Reference(CORE, ABOVE) as reference:
            arm.on("greedy")
            wait_for(
                lambda: arm.status("greedy").cycle >= 1, "seconds of real-time load", 30
            )
            longest = reference.longest()
    finally:
        starved.kill()
        starved.wait()
    if longest < 0.03:
        pytest.skip(
            f"the kernel does not throttle: no stall above {longest * 1e3:.0f} ms in "
            "3.2 s of real-time load"
        )
    event = arm.wait_event("CORE_STALLED")
    assert event.severity == Severity.WARNING
    assert f"core {CORE} stood still" in event.text
    assert "kernel throttles" in event.text
    status = arm.rtpu_status()
    assert status.stalls >= 1
    assert status.stalled >= 0.02
    arm.wait_cycles("t", 20)


@needs_fifo
@pytest.mark.skipif(os.geteuid() != 0, reason="only root's process can lose a right")
def test_rights_lost_halfway_are_told_and_survived(nodes, tmp_path, monkeypatch):
    """The kernel refuses the dispatcher its calls from some moment on."""
    (tmp_path / "sitecustomize.py").write_text(GIVES_UP)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    for number in range(3):
        arm.spawn(f"t{number}", "counts", out=f"Y{number}", freq=100.0 + number)
        arm.on(f"t{number}")
    arm.wait_cycles("t0", 5)
    rtpu = nodes.state("arm0").pid
    assert arm.events("CALLS_REFUSED") == []
    os.kill(rtpu, signal.SIGUSR2)
    wait_for(lambda: effective_user(rtpu) == NOBODY, "the loss of its rights")
    arm.off("t1")
    arm.on("t1")
    event = arm.wait_event("CALLS_REFUSED")
    assert event.severity == Severity.ERROR
    assert f"calls about tasks of core {CORE}" in event.text
    assert "pbonet doctor" in event.text
    for number in range(3):
        arm.wait_cycles(f"t{number}", 20)
    os.kill(rtpu, signal.SIGUSR2)
    wait_for(lambda: effective_user(rtpu) == 0, "its rights")
    assert arm.stop().killed == []


def effective_user(pid):
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    line = next(line for line in status.splitlines() if line.startswith("Uid:"))
    return int(line.split()[2])
