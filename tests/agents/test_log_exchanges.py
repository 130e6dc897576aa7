"""What tasks did that were exchanged, or that stood by, is verified from the log."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from watching import wait_for

from pbonet.log import Log, is_complete
from pbonet.testing import verify
from pbonet.xm.net import messages as m

GLIDES = '''
from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, PortBasedObject, Vector


class Glides(PortBasedObject):
    """Goes on from where the one before it was, unless that one went to zero."""

    n: A[int, InConst("N", "1", "size")]
    z: A[Vector, InVar("Z", "n", "none", "input")]
    y: A[Vector, OutVar("Y", "n", "none", "sum")]

    def on(self) -> None:
        self.y += self.task.now * 1e-9 + self.task.handover

    def cycle(self, dt: float) -> None:
        self.y += self.z * dt + self.task.now * 1e-12

    def off(self) -> None:
        self.y += 0.5
        if not self.task.handover:
            self.y[:] = 0.0
'''
RMOD = """MODULE glides
DESC glides
SVARALIAS Z={z}
SVARALIAS Y={y}
INCONST N
OUTCONST none
INVAR Z
OUTVAR Y
TASKTYPE periodic
FREQ 250
EOF
"""
TASKS = {"a": ("X", "Y0"), "b": ("Y0", "Y1"), "c": ("X", "Y0")}


@pytest.fixture
def line(nodes):
    """X to a to Y0 to b to Y1, all ON, and c, OFF, which can do what a does."""
    nodes.write_module("glides", GLIDES)
    nodes.agent_process("arm0")
    master = nodes.master("arm0", "arm")
    got = master.ask(m.Record(run="r", mode="outputs"), m.Recorded)
    wait_for(lambda: master.rtpu_status().log, "the log")
    for task, (z, y) in TASKS.items():
        master.spawn(task, "glides", text=RMOD.format(z=z, y=y))
    master.on("a")
    master.on("b")
    master.path = Path(got.path)
    return master


def finish(line):
    """End all tasks and the log; return it and its verdicts: nothing diverges."""
    for task in line.status():
        line.kill(task)
    line.ask(m.Record(mode="off"), m.Recorded)
    wait_for(lambda: is_complete(line.path), "the end of the log")
    log = Log(line.path.parent)
    assert log.lost() == {}
    verdicts = {one.task: one for one in verify(log)}
    assert not any(one.divergence for one in verdicts.values()), str(verdicts)
    return log, verdicts


def test_tasks_that_were_exchanged_give_the_same_again(line):
    old, new = "a", "c"
    for _ in range(4):
        line.wait_cycles("b", 10)
        request = m.Reconfig(items=[(old, "off"), (new, "on")])
        done = line.ask(request, m.Reconfigured)
        assert done.states == {old: "OFF", new: "ON"}
        old, new = new, old
    line.wait_cycles("b", 10)
    log, verdicts = finish(line)
    for task in TASKS:
        assert verdicts[task].good, str(verdicts[task])
        assert verdicts[task].cycles == len(log.arrays(task)["cycle"]) > 10


def test_a_standby_that_was_engaged_gives_the_same_again(line):
    line.ask(m.Standby(task="c", original="a"), m.TaskStatus)
    wait_for(lambda: line.status("c").stands_by, "c standing by")
    line.wait_cycles("b", 10)
    os.kill(line.status("a").tid, signal.SIGKILL)
    line.wait_event("FALLBACK", "c")
    line.wait_cycles("c", 10)
    line.wait_cycles("b", 10)
    log, verdicts = finish(line)
    assert verdicts["c"].good, str(verdicts["c"])
    assert verdicts["c"].cycles == len(log.arrays("c")["cycle"]) > 10
