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
import numpy as np

from pbonet.io.spp import Library

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
        self.spp = Spp("fpa", "kernels.py", task=self.task, max_age=0.3)
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


def test_an_executive_is_told_lost_restarted_endless_and_replayed(nodes):
    fpa = SppEntry(driver="numpy", memory=100.0, longest=2.0)
    nodes.write_module("uses", USES)
    nodes.write_module("kernels", KERNELS)
    nodes.agent_process("arm0", spp={"fpa": fpa})
    arm = nodes.master("arm0", "arm")

    def processor():
        (found,) = arm.rtpu_status().spps
        return found

    def routine(name):
        arm.ask(m.Set(task="first", name="what", value=name))

    # What it needs is not there: refused before the start.
    text = rmod("uses").replace("EOF", "NEEDS spp cuda\nEOF")
    error = arm.refused(SppError, arm.spawn, "first", "uses", text=text)
    assert "has cuda" in str(error)
    assert "numpy on cpu" in str(error)

    path = record(arm)
    arm.spawn("first", "uses", text=rmod("uses", freq=100.0, critical=True))
    arm.on("first")
    wait_for(lambda: arm.value("Y0").values[0] > 2.0, "results")

    # The back end is said in four places.
    wait_for(lambda: processor().libraries, "the library")
    one = processor()
    assert (one.back_end, one.device, one.starts) == ("numpy", "cpu", 1)
    assert one.libraries == [f"{nodes.library / 'kernels.py'} on numpy cpu"]
    assert f"fpa runs numpy on cpu, process {one.pid}" in doctor(nodes)
    wait_for(
        lambda: any("kernels.py" in e.text for e in arm.events("SPP_READY")),
        "the event that tells the back end of the library",
    )
    assert "runs numpy on cpu" in arm.events("SPP_READY")[0].text

    routine("say")
    assert "a kernel says something" in arm.wait_event("SPP_OUTPUT").text

    # Too much memory: an error of that routine, and the executive goes on.
    routine("hog")
    event = arm.wait_event("WARNING", "first")
    assert "MemoryError" in event.text
    assert "kernels.py:" in event.text
    routine("update")

    # Killed: stale, flag, stable, and another one, which its client goes on with.
    os.kill(one.pid, signal.SIGKILL)
    arm.wait_event("SPP_DIED")
    arm.wait_event("ILLEGAL")
    arm.wait_event("LEGAL")
    wait_for(lambda: processor().starts == 2 and processor().back_end, "another one")
    wait_for(lambda: arm.value("Y0").values[1] == 1.0, "cycle again")

    # A kernel without an end: the task goes on, and the executive is ended.
    routine("endless")
    wait_for(lambda: arm.value("Y0").values[1] == -1.0, "stable")
    arm.wait_cycles("first", 100)
    wait_for(lambda: processor().error, "the end of the endless one")
    assert "a batch took more than 2 s" in processor().error
    arm.wait_cycles("first", 20)
    arm.off("first")
    arm.kill("first")
    log = finish(arm, path)
    (nodes.library / "kernels.py").unlink()
    (verdict,) = verify(log, ["first"])
    assert verdict.good, str(verdict)
    assert verdict.cycles
