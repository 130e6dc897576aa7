"""Every cause of the illegal-configuration flag: raised, obeyed, told, withdrawn."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from nodekit import rmod, svar
from watching import wait_for

from pbonet.node.ring._ring import Ring
from pbonet.node.rtpu.tables import table_name
from pbonet.svar import Table
from pbonet.xm.net import messages as m

AGED = """
NAME OLD
TYPE double
DESC a variable that ages
UNITS none
NELEM 2
MAXAGE 0.1

EOF
"""
ALARMIST = '''
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Heat(Params):
    """How it is."""

    hot: A[bool, param("none", "whether it is too hot")] = False


class Alarmist(PortBasedObject[Heat]):
    """Says that nobody should trust it."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def cycle(self, dt: float) -> None:
        self.y[:] = 1.0

    def set(self, name: str, value: object) -> None:
        if value:
            self.task.illegal("too hot")
        else:
            self.task.legal()
'''
LINGERS = """
import time
from pathlib import Path
from typing import Annotated as A

from pbonet import Params, PortBasedObject, param


class Files(Params):
    begun: A[str, param("none", "written when `kill` begins")]
    go_on: A[str, param("none", "`kill` ends when it is there")]


class Lingers(PortBasedObject[Files]):
    def cycle(self, dt: float) -> None:
        pass

    def kill(self) -> None:
        Path(self.params.begun).touch()
        while not Path(self.params.go_on).exists():
            time.sleep(0.005)
"""


@pytest.fixture
def arm(nodes):
    """A master; `hold` is critical, reads OLD and writes Y1, 3 or in stable -1."""
    nodes.agent("arm0")
    master = nodes.master("arm0", "t", table=False)
    master.open_table(svar().replace("\nEOF\n", AGED))
    yield master
    master.stop()


def hold(arm, reads):
    text = rmod("holds", "Y1", invar=reads, critical=True, local={"LEVEL": 3})
    arm.spawn("hold", "", text=text)
    arm.on("hold")


def value(arm):
    return arm.value("Y1").values[0]


def wait_level(arm, level):
    wait_for(lambda: value(arm) == level, f"level {level}")


def illegal(arm):
    return arm.rtpu_status().illegal


def texts(arm, code):
    return [event.text for event in arm.events(code)]


def test_a_stale_input_makes_a_critical_task_stable(arm):
    cause = "the input OLD of hold is stale (arm0/hold)"
    arm.spawn("source", "counts", out="OLD")
    hold(arm, "OLD")
    wait_level(arm, -1.0)  # it was never written
    wait_for(lambda: illegal(arm) == [cause], "others know when its limit has passed")
    arm.on("source")
    # At one look: a machine that stalls makes the input stale once more.
    wait_for(lambda: not illegal(arm) and value(arm) == 3.0, "a fresh input")
    arm.off("source")
    wait_level(arm, -1.0)
    wait_for(lambda: illegal(arm) == [cause], "the cause")
    assert arm.status("hold").state == "ON"
    arm.off("hold")  # nobody is concerned any more
    assert illegal(arm) == []
    wait_for(lambda: len(texts(arm, "LEGAL")) >= 2, "both ends as events")
    assert set(texts(arm, "ILLEGAL")) == {cause}
    assert set(texts(arm, "LEGAL")) == {f"no longer: {cause}"}


def test_stable_runs_from_the_very_next_cycle_on(arm, nodes):
    """A writer is killed: who was released behind that runs `stable`, every cycle."""
    arm.spawn("source", "counts", out="Y0")
    arm.on("source")
    hold(arm, "Y0")
    wait_level(arm, 3.0)
    ring = Ring.attach(arm.status("hold").ring)
    with closing(ring), Table.attach(table_name(nodes.domain, "t")) as table:
        ring.drain()
        os.kill(arm.status("source").tid, signal.SIGKILL)
        wait_level(arm, -1.0)
        arm.wait_cycles("hold", 5)
        (cause,) = table.illegal
        cycles = [one for one in ring.drain() if not one.kind]
    assert "source" in cause.cause
    behind = [one.stable for one in cycles if one.release_ns > cause.time_ns]
    assert len(behind) >= 5
    assert all(behind)
    numbers = [one.cycle for one in cycles]
    assert numbers == list(range(numbers[0], numbers[0] + len(cycles)))


def test_a_module_raises_and_withdraws(arm, nodes):
    nodes.write_module("alarmist", ALARMIST)
    arm.spawn("fire", "alarmist", out="Y0")
    hold(arm, "Y0")
    arm.on("fire")
    wait_level(arm, 3.0)
    set_hot(arm, "yes")
    wait_level(arm, -1.0)
    assert illegal(arm) == ["too hot (arm0/fire)"]
    assert arm.status("fire").signals["ILLEGAL"] == 1
    set_hot(arm, "no")
    wait_level(arm, 3.0)
    assert illegal(arm) == []
    assert arm.status("fire").signals["LEGAL"] == 1
    set_hot(arm, "yes")
    wait_level(arm, -1.0)
    arm.off("fire")
    wait_level(arm, 3.0)  # it ends with its task being ON
    arm.on("fire")
    set_hot(arm, "yes")
    wait_level(arm, -1.0)
    os.kill(arm.status("fire").tid, signal.SIGKILL)
    wait_for(lambda: illegal(arm) == ["fire has died (arm0/fire)"], "only its death")
    arm.kill("fire")
    wait_level(arm, 3.0)
    wait_for(lambda: "too hot (arm0/fire)" in texts(arm, "ILLEGAL"), "its event")


@pytest.mark.parametrize("who", ["task", "fork server"])
def test_a_task_that_ends_unasked(arm, nodes, who):
    """It turns itself off in order, but nobody had asked for that."""
    tid = arm.spawn("source", "counts", out="Y0").tid
    arm.on("source")
    arm.wait_cycles("source", 2)
    if who == "task":
        hold(arm, "Y0")
        wait_level(arm, 3.0)
    os.kill(tid if who == "task" else nodes.fork_server("arm0"), signal.SIGTERM)
    cause = "source has ended by itself (arm0/source)"
    wait_for(lambda: illegal(arm) == [cause], "the flag")
    if who == "task":
        wait_level(arm, -1.0)
    arm.wait_event("TASK_DIED", "source")
    assert illegal(arm) == [cause]
    arm.spawn("source", "counts", out="Y0")
    wait_for(lambda: illegal(arm) == [], "its return")


@pytest.mark.parametrize("heir", ["source", "other"])
def test_a_reconfiguration_that_takes_longer_than_a_cycle(arm, tmp_path, heir):
    """Whether tasks take each other's place at the dispatcher or one by one."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    files = {"BEGUN": begun, "GO_ON": go_on}
    arm.spawn("old", "waits_in_off", out="Y0", local=files)
    arm.spawn("new", "counts", out="Y0" if heir == "source" else "OLD")
    arm.on("old")
    cause = "a reconfiguration takes longer than a cycle (arm0/reconfiguration)"
    items = [("old", "off"), ("new", "on")]
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(arm.ask, m.Reconfig(items=items), m.Reconfigured)
        try:
            wait_for(begun.exists, "the beginning of off")
            wait_for(lambda: illegal(arm) == [cause], "the flag")
        finally:
            go_on.touch()
        assert done.result().done == 2
    assert illegal(arm) == []
    told = [f"no longer: {cause}"]
    wait_for(lambda: texts(arm, "LEGAL") == told, "its end as an event")


def test_a_task_that_is_off_is_killed_in_no_hurry(arm, nodes, tmp_path):
    """Behind a switch nobody's inputs depend on how long a kill takes."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    nodes.write_module("lingers", LINGERS)
    arm.spawn("old", "lingers", out="", local={"BEGUN": begun, "GO_ON": go_on})
    arm.spawn("source", "counts", out="Y0")
    arm.on("source")
    hold(arm, "Y0")
    with ThreadPoolExecutor(1) as pool:
        request = m.Reconfig(items=[("old", "kill")])
        done = pool.submit(arm.ask, request, m.Reconfigured)
        try:
            wait_for(begun.exists, "the beginning of kill")
            arm.wait_cycles("hold", 50)
            assert illegal(arm) == []
        finally:
            go_on.touch()
        assert done.result().done == 1
    assert texts(arm, "ILLEGAL") == []


@pytest.mark.parametrize("module", ["hangs_in_cycle", "hangs_in_off"])
def test_a_task_that_is_ended_by_force_leaves_the_flag_as_any_that_died(arm, module):
    """No master follows up: what it wrote has no writer until somebody decides."""
    arm.spawn("bad", module, out="Y0", freq=100.0)
    hold(arm, "Y0")
    arm.on("bad")
    if module == "hangs_in_cycle":
        arm.wait_event("HANGS", "bad")
    arm.kill("bad", limit=1.0)
    arm.wait_event("FORCED", "bad")
    assert illegal(arm) == ["bad has died (arm0/bad)"]
    assert arm.status("bad").state == "NOT-CREATED"
    wait_level(arm, -1.0)
    arm.kill("bad")
    wait_level(arm, 3.0)
    assert illegal(arm) == []


def set_hot(arm, word):
    arm.ask(m.Set(task="fire", name="hot", value=word), list[m.ParamValue])


def test_an_error_and_a_death_are_told_by_the_vigil(arm):
    arm.spawn("bad", "raises_in_cycle")
    hold(arm, "Y0")
    arm.on("bad")
    wait_level(arm, -1.0)
    assert illegal(arm) == ["bad is in ERROR (arm0/bad)"]
    arm.control("bad", "clear")
    wait_level(arm, 3.0)
    arm.on("bad")
    wait_level(arm, -1.0)
    arm.kill("bad")
    wait_level(arm, 3.0)
    cause = "bad is in ERROR (arm0/bad)"

    def told():
        up, down = texts(arm, "ILLEGAL"), texts(arm, "LEGAL")
        return (up.count(cause), down.count(f"no longer: {cause}")) == (2, 2)

    wait_for(told, "both errors and both ends as events")
