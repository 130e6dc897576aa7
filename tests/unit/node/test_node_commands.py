"""A command that waits for a task: how long it was given is what its error says."""

import asyncio
import contextlib
import os
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from pbonet.errors import NoAnswerError
from pbonet.node.rtpu import signal_tasks
from pbonet.node.rtpu.task_handle import Task
from pbonet.node.wire import CoreWait, core_wait
from pbonet.node.wire.core_wait import MainThreadTimes, main_thread_times


@contextlib.asynccontextmanager
async def running(exited, ended=lambda *_: None):
    """Give a task of which only the files are real, and the far end of its socket."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    read, write = os.pipe()
    os.set_blocking(read, False)
    near.setblocking(False)
    child = SimpleNamespace(
        sock=near,
        out=read,
        pid=0,
        send_signal=lambda _: None,
        core_wait=lambda: CoreWait(0),
        exited=exited,
        crash_text=lambda: "",
        close=lambda: None,
    )
    facts = SimpleNamespace(
        name="servo", slot=0, subsystem="arm", rmod=SimpleNamespace(freq=1.0)
    )
    task = Task(
        *(facts, child),
        wake=lambda _: None,
        tell=lambda *_: None,
        changed=lambda: None,
        ended=ended,
    )
    task._busy.clear()
    try:
        yield task, far
    finally:
        task._life.cancel()
        await asyncio.gather(task._life, return_exceptions=True)
        asyncio.get_running_loop().remove_reader(read)
        far.close()
        near.close()
        os.close(read)
        os.close(write)


async def late(given):
    """Return the error of a command that waited for an earlier one first."""

    async def turn(_):
        return 0.0012

    async with running(asyncio.Future()) as (task, _):
        task._turn = turn
        await task._lock.acquire()
        with pytest.raises(NoAnswerError) as caught:
            await task.command("off", lambda n: SimpleNamespace(n=n), given)
        return caught.value


def test_the_limit_that_was_given_is_told_not_what_was_left_of_it(monkeypatch):
    monkeypatch.setattr("pbonet.node.wire.rtpu_messages.encode", lambda _: b"off")
    error = asyncio.run(late(2.0))
    assert error.what == "the task did not finish 'off' within 2 s"


async def killed_amid_its_end():
    """Return what is known of a task at the answer to a `kill` amid its own end."""

    def ended(task, code):
        task.last_status = code

    exited = asyncio.Future()
    async with running(exited, ended) as (task, far):
        far.close()
        asyncio.get_running_loop().call_later(0.05, exited.set_result, 70)
        rtpu = SimpleNamespace(
            core=SimpleNamespace(snapshot=lambda _: SimpleNamespace(hung=False)),
            tombs={},
            bury=lambda *_: None,
        )
        await signal_tasks.kill(rtpu, task, 1.0)
        return task.last_status


def test_a_kill_is_answered_when_the_task_has_ended():
    """One that ends by itself takes no messages before its end is noticed."""
    assert asyncio.run(killed_amid_its_end()) == 70


ASLEEP_THEN_BUSY = """
import sys
sys.stdin.readline()
print("busy", flush=True)
while True:
    pass
"""


def test_time_asleep_is_no_wait_for_the_core_of_a_process_that_computes_then():
    with subprocess.Popen(
        [sys.executable, "-c", ASLEEP_THEN_BUSY],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        try:
            wait = CoreWait(process.pid)
            time.sleep(1.0)  # it waits for a line, and starts before that
            process.stdin.write(b"\n")
            process.stdin.flush()
            assert process.stdout.readline() == b"busy\n"
            begun = time.monotonic()
            told, counted = wait.seconds(), main_thread_times(process.pid).ready
            later = max(wait.seconds() for _ in range(50))
            assert later - told <= time.monotonic() - begun
            assert told <= counted * 1e-9 + time.monotonic() - begun
        finally:
            process.kill()


def test_a_ready_process_whose_counts_stand_still_waits_for_its_core(monkeypatch):
    """Its wait is in the kernel's counts only when it runs again."""
    counts = MainThreadTimes(ran=5, ready=7)
    monkeypatch.setattr(core_wait, "main_thread_times", lambda _: counts)
    monkeypatch.setattr(core_wait, "stat", lambda _: SimpleNamespace(state="R"))
    clock = iter([10**9, 3 * 10**9, 4 * 10**9])
    monkeypatch.setattr(core_wait.time, "monotonic_ns", lambda: next(clock))
    wait = CoreWait(1)
    assert wait.seconds() == 2.0
    counts = MainThreadTimes(ran=6, ready=7 + 2 * 10**9)
    assert wait.seconds() == 2.0
