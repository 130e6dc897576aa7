"""Special purpose processors of an agent: told, lost, endless, refused, replayed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

from log_of_real_tasks import finish, record
from nodekit import rmod
from watching import wait_for

from pbonet.config import SppEntry
from pbonet.errors import SppError
from pbonet.testing import verify
from pbonet.xm.net import messages as m

KERNELS = """
import os
import time

import numpy as np

from pbonet.io.spp import Library

while os.path.exists("wait"):
    time.sleep(0.01)
library = Library()
library.variable("x", 2)
library.variable("u", 2)


@library.routine("numpy")
def update(m):
    m.u[:] = 2.0 * m.x


@library.routine("numpy")
def say(m):
    if not hasattr(m.local, "said"):
        m.local.said = True
        open("said.txt", "w").write("a kernel writes something")
        print("a kernel says something")
    update(m)


@library.routine("numpy")
def hog(m):
    m.local.big = np.ones(40_000_000)


@library.routine("numpy")
def endless(m):
    while True:
        pass
"""
USES = """
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import SppError
from pbonet.io.spp import Spp


class How(Params):
    what: A[str, param("none", "the routine")] = "update"


class Uses(PortBasedObject[How]):
    y: A[Vector, OutVar("Y", "2", "none", "what came back, and 1 in cycle")]

    def init(self) -> None:
        self.spp = Spp("fpa", "kernels.py", task=self.task, max_age=1.0)
        self.x, self.u = map(self.spp.translate, ("x", "u"))
        names = "update", "say", "hog", "endless"
        self.routines = {name: self.spp.translate(name) for name in names}

    def cycle(self, dt: float) -> None:
        self.use()
        self.y[1] = 1.0

    def stable(self, dt: float) -> None:
        self.use()
        self.y[1] = -1.0

    def use(self) -> None:
        self.spp.write(self.x, (self.task.cyclecount, 1.0))
        self.spp.call(self.routines[self.params.what])
        try:
            value = self.spp.read(self.u).value
            self.spp.wait()
        except SppError as error:
            self.task.warn(str(error))
            return
        if value is not None:
            self.y[0] = value[0]
"""


def doctor(nodes):
    """Return what ``pbonet doctor`` prints."""
    words = ["doctor", "--domain", nodes.domain]
    command = [sys.executable, "-m", "pbonet.cli", *words]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=200, check=False
    ).stdout


def processor(arm):
    """Return the status of the processor."""
    (found,) = arm.rtpu_status().spps
    return found


def refused_without_cuda(arm):
    """See that a task is not spawned that needs what is not there."""
    text = rmod("uses").replace("EOF", "NEEDS spp cuda\nEOF")
    error = arm.refused(SppError, arm.spawn, "first", "uses", text=text)
    assert "has cuda" in str(error)
    assert "numpy on cpu" in str(error)


def told_everywhere(nodes, arm):
    """See that status, doctor and event say what the library runs on."""
    wait_for(lambda: processor(arm).libraries, "the library")
    one = processor(arm)
    assert (one.back_end, one.device, one.starts) == ("numpy", "cpu", 1)
    assert one.libraries == [f"{nodes.library / 'kernels.py'} on numpy cpu"]
    assert f"fpa runs numpy on cpu, process {one.pid}" in doctor(nodes)
    wait_for(
        lambda: any("kernels.py" in e.text for e in arm.events("SPP_READY")),
        "the event that tells the back end of the library",
    )
    assert "runs numpy on cpu" in arm.events("SPP_READY")[0].text


def nothing_stays_of_a_client_that_is_killed(arm):
    arm.spawn("second", "uses", text=rmod("uses", "Y1", freq=100.0))
    wait_for(lambda: len(processor(arm).libraries) == 2, "two clients")
    os.kill(arm.status("second").tid, signal.SIGKILL)
    arm.wait_event("TASK_DIED", "second")
    wait_for(lambda: len(processor(arm).libraries) == 1, "one client")


def test_an_executive_is_told_lost_restarted_endless_and_replayed(nodes, tmp_path):
    fpa = SppEntry(driver="numpy", memory=100.0, longest=1.0)
    nodes.write_module("uses", USES)
    nodes.write_module("kernels", KERNELS)
    files = tmp_path / "files"
    files.mkdir()
    nodes.agent_process("arm0", spp={"fpa": fpa}, files=str(files))
    arm = nodes.master("arm0", "arm")

    def routine(name):
        arm.ask(m.Set(task="first", name="what", value=name))

    refused_without_cuda(arm)
    path = record(arm)
    arm.spawn("first", "uses", text=rmod("uses", freq=100.0, critical=True))
    arm.on("first")
    wait_for(lambda: arm.value("Y0").values[0] > 2.0, "results")

    told_everywhere(nodes, arm)
    pid = processor(arm).pid
    routine("say")
    assert "a kernel says something" in arm.wait_event("SPP_OUTPUT").text
    assert (files / "said.txt").read_text() == "a kernel writes something"

    # Too much memory: an error of that routine, and the executive goes on.
    routine("hog")
    event = arm.wait_event("WARNING", "first")
    assert "MemoryError" in event.text
    assert "kernels.py:" in event.text
    routine("update")

    nothing_stays_of_a_client_that_is_killed(arm)

    # Killed: stale, flag, stable, and another one, which its client goes on with.
    (files / "wait").touch()  # the other one is not ready before its results are missed
    os.kill(pid, signal.SIGKILL)
    arm.wait_event("SPP_DIED")
    wait_for(lambda: arm.rtpu_status().illegal, "the flag")
    wait_for(lambda: arm.value("Y0").values[1] == -1.0, "stable")
    (files / "wait").unlink()
    wait_for(
        lambda: processor(arm).starts == 2 and processor(arm).back_end, "another one"
    )
    wait_for(lambda: arm.value("Y0").values[1] == 1.0, "cycle again")
    wait_for(lambda: not arm.rtpu_status().illegal, "no flag")

    # A kernel without an end: the task goes on, and the executive is ended.
    routine("endless")
    wait_for(lambda: arm.value("Y0").values[1] == -1.0, "stable")
    arm.wait_cycles("first", 50)
    wait_for(lambda: processor(arm).error, "the end of the endless one")
    assert "a batch took more than 1 s" in processor(arm).error
    arm.wait_cycles("first", 20)
    arm.off("first")
    arm.kill("first")
    log = finish(arm, path)
    (nodes.library / "kernels.py").unlink()
    (verdict,) = verify(log, ["first"])
    assert verdict.good, str(verdict)
    assert verdict.cycles
