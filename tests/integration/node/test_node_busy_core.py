"""Commands to a task whose core another program has: what they wait for is told."""

import subprocess
import sys

import pytest
from nodekit import CORE
from watching import wait_for

from pbonet.errors import NoAnswerError
from pbonet.node.rt import _rt

pytestmark = pytest.mark.skipif(
    not _rt.probe().fifo, reason="; ".join(_rt.probe().reasons)
)
OCCUPIES = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))
print("has it", flush=True)
end = time.monotonic() + float(sys.argv[2])
while time.monotonic() < end:
    pass
"""


@pytest.fixture
def occupy():
    """Have another program use the core of the tasks, above everything else there."""
    processes = []

    def begin(seconds):
        process = subprocess.Popen(
            [sys.executable, "-c", OCCUPIES, str(CORE), str(seconds)],
            stdout=subprocess.PIPE,
        )
        processes.append(process)
        assert process.stdout.readline() == b"has it\n"
        return process

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


def test_time_without_the_core_is_not_the_task_s(arm, occupy):
    arm.spawn("a", "counts")
    occupy(1.0)
    assert arm.on("a", limit=0.7).state == "ON"


def test_a_task_that_never_gets_its_core_is_not_said_to_hang(arm, occupy):
    arm.spawn("a", "counts")
    busy = occupy(30.0)
    error = arm.refused(NoAnswerError, arm.on, "a", limit=0.1)
    assert "did not finish 'on' within 0.3 s, of which it waited 0.2 s" in error.what
    assert "what else uses the core" in error.remedy
    busy.kill()
    wait_for(lambda: arm.status("a").state == "ON", "it comes on when it has its core")


def test_a_task_that_waits_by_itself_gets_its_limit(arm, tmp_path):
    files = {"BEGUN": tmp_path / "begun", "GO_ON": tmp_path / "go on"}
    arm.spawn("a", "waits_in_off", local=files)
    arm.on("a")
    error = arm.refused(NoAnswerError, arm.off, "a", limit=0.5)
    assert error.what == "the task did not finish 'off' within 0.5 s"
    files["GO_ON"].touch()
