"""Threads that are given a core soon after waking, by short slices."""

import ctypes
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.node import rt

GETATTR = {"x86_64": 315, "aarch64": 275}
PROGRAM = """
import os, resource, threading
from test_svar_slice import attributes
from pbonet.svar import short_slices
os.nice(3)
if {batch}:
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
if {weak}:
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    os.setuid(os.getuid() or 65534)
print(*attributes(0))
assert short_slices() == {works}
print(*attributes(0))
thread = threading.Thread(target=lambda: print(*attributes(0)))
thread.start()
thread.join()
"""


def attributes(tid):
    """Return policy, nice and slice of a thread, as the kernel has them."""
    room = ctypes.create_string_buffer(48)
    number = GETATTR[os.uname().machine]
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.syscall(number, tid, room, 48, 0) == 0, ctypes.get_errno()
    _, policy, _, nice, _, slice_ns, _, _ = struct.unpack("=IIQiIQQQ", room.raw)
    return policy, nice, slice_ns


def of_a_process(*, batch=False, weak=False):
    """Return the attributes before, after, and of a thread that begins then."""
    words = [
        sys.executable,
        "-c",
        PROGRAM.format(batch=batch, weak=weak, works=not weak),
    ]
    folder = str(Path(__file__).parent)
    done = subprocess.run(
        words, capture_output=True, text=True, check=True,
        env=os.environ | {"PYTHONPATH": folder},
    )  # fmt: skip
    return [tuple(map(int, line.split())) for line in done.stdout.splitlines()]


def test_slices_become_short_and_nothing_else_changes() -> None:
    if not rt.probe().fifo:
        pytest.skip("this user may not have SCHED_FIFO")
    before, after, thread = of_a_process()
    if not before[2]:
        pytest.skip("this kernel has no slices that can be set (Linux 6.12)")
    assert after == thread == (before[0], before[1], 100_000)
    assert before[1] > 0, "its nice value, which the test's own adds to"
    assert before[2] > 100_000


def test_a_thread_of_another_policy_stays_as_it_is() -> None:
    before, after, _ = of_a_process(batch=True)
    assert before == after
    assert before[0] == os.SCHED_BATCH


def test_where_tasks_are_ordinary_processes_none_runs_before_them() -> None:
    before, after, thread = of_a_process(weak=True)
    assert before == after == thread
