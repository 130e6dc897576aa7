"""Swaps that fail midway, over real agents and tasks, and what is done about it."""

from __future__ import annotations

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from long_limits import LIMIT
from nodekit import alive, rmod, svar, wait_gone
from watching import causes, states, wait_for

from pbonet.errors import (
    MethodError,
    NoAnswerError,
    PbonetError,
    ReconfigError,
    StateError,
    VerificationError,
)
from pbonet.master.subsystem import subsystem_tasks
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.svar import Table
from pbonet.xm.net import messages as m

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
SAFE = (-7.0, -7.0)
"""What tests/misbehaving/overruns.py declares."""
FAILS = """
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Fails(PortBasedObject):
    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        raise ZeroDivisionError("no cycle works")
"""
WAITS_IN_ON = """
import time
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Files(Params):
    begun: A[str, param("none", "written when `on` begins")]
    go_on: A[str, param("none", "`on` ends when it is there")]


class Waits(PortBasedObject[Files]):
    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def on(self) -> None:
        Path(self.params.begun).touch()
        while not Path(self.params.go_on).exists():
            time.sleep(0.005)

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
"""


@pytest.fixture
def write(tmp_path):
    """Write an RMOD of a module in `misbehaving` beside the subsystem."""

    def one(name, module, **settings):
        (tmp_path / f"{name}.rmod").write_text(rmod(module, **settings))

    return one


@pytest.fixture
def arm(nodes, tmp_path, write):
    """Two RTPUs; `stays` is ON, `good` is OFF, and writes what others will."""
    nodes.agent_processes("arm0", "arm1")
    (tmp_path / "t.sbs").write_text(SBS)
    (tmp_path / "t.svar").write_text(svar())
    write("stays", "counts", out="Y1")
    write("good", "counts", out="Y0", local={"DIARY": tmp_path / "good.txt"})
    subsystem = Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _text: None,
    ).open()
    subsystem.spawn("stays", "arm0")
    subsystem.control("stays", "on")
    subsystem.spawn("good", "arm0")
    yield subsystem
    subsystem.finish()


def writer(arm, name="Y0"):
    return arm.display([name])[0].writer


def start(arm, task, rtpu="arm0"):
    arm.spawn(task, rtpu)
    arm.control(task, "on")


def test_off_that_raises_frees_the_place_and_the_rest_can_be_sent(arm, write):
    write("bad", "raises_in_off")
    start(arm, "bad")
    with pytest.raises(ReconfigError) as caught:
        arm.swap("bad", "good")
    assert (caught.value.done, caught.value.rest) == (
        0,
        (("bad", "off"), ("good", "on")),
    )
    assert "item 1 of 2, off bad" in str(caught.value)
    assert "off does not work" in str(caught.value)
    assert "not sent: on good" in str(caught.value)
    assert isinstance(caught.value.__cause__, MethodError)
    assert states(arm) == {"stays": "ON", "bad": "ERROR", "good": "OFF"}
    assert arm.reconfig(caught.value.rest[1:]) == {"good": "ON"}
    assert writer(arm) == "good"


def test_on_that_raises_and_back_again(arm, write, tmp_path):
    write("bad", "raises_in_on")
    arm.control("good", "on")
    with pytest.raises(ReconfigError) as caught:
        arm.swap("good", "bad")
    assert caught.value.done == 1
    assert "item 2 of 2, on bad" in str(caught.value)
    assert "done: off good" in str(caught.value)
    assert states(arm) == {"stays": "ON", "bad": "ERROR", "good": "OFF"}
    with pytest.raises(StateError, match="'clear bad' brings it out of ERROR"):
        arm.swap("good", "bad")
    assert arm.swap("bad", "good").items == [("good", "on")]
    assert writer(arm) == "good"
    text = (tmp_path / "good.txt").read_text()
    assert "off True" in text  # it was told that somebody would take over


@pytest.mark.parametrize("rtpu", ["arm0", "arm1"])
def test_a_switch_kills_nobody_for_a_task_that_fails_at_once(
    arm, nodes, write, tmp_path, rtpu
):
    """It fails in its first cycle; who stands by for it is there by then."""
    nodes.write_module("fails_at_once", FAILS)
    write("bad", "fails_at_once")
    write("third", "counts")
    for job, line in (
        ("one", "TASK good arm0"),
        ("two", f"TASK bad {rtpu} FALLBACK third"),
    ):
        text = f"JOB {job}\nDESC\nSBS t.sbs\n{line}\nTASK stays arm0\nEOF\n"
        (tmp_path / f"{job}.job").write_text(text)
    arm.switch("one")
    with pytest.raises(ReconfigError) as caught:
        arm.switch("two")
    assert (caught.value.done, caught.value.rest) == (2, (("good", "kill"),))
    assert "bad, which has come on, has failed" in str(caught.value)
    assert "no cycle works" in str(caught.value)
    assert "no task was killed" in str(caught.value)
    states_then = {"stays": "ON", "good": "OFF", "bad": "ERROR", "third": "ON"}
    wait_for(lambda: states(arm) == states_then, "that the fallback is ON")
    wait_for(lambda: not causes(arm), "a legal configuration")
    with pytest.raises(
        StateError, match="'clear bad' brings it out of ERROR, 'kill bad' removes it"
    ):
        arm.switch("two")
    back = arm.switch("one")
    assert back.items == [("third", "off"), ("good", "on")]
    assert states(arm) == {"stays": "ON", "good": "ON"}
    assert writer(arm) == "good"


def test_off_that_hangs_is_given_up_and_killed(arm, gate, briefly):
    """On another RTPU; it leaves the core, which both share here, to its heir."""
    begun, _ = gate
    start(arm, "old", "arm1")
    before = arm.status("stays")
    with briefly(), pytest.raises(ReconfigError) as caught:
        arm.swap("old", "good")
    wait_for(begun.exists, "the beginning of off")
    assert isinstance(caught.value.__cause__, NoAnswerError)
    assert (caught.value.done, caught.value.rest) == (
        0,
        (("old", "off"), ("good", "on")),
    )
    said = str(caught.value)
    assert "item 1 of 2, off old: the task did not finish 'off'" in said
    assert "not sent: on good" in said
    assert "not known" not in said  # it was the task that did not answer
    assert states(arm) == {"stays": "ON", "old": "ON", "good": "OFF"}
    assert writer(arm) == "old"
    assert set(causes(arm)) == {"old hangs in off (arm1/old)"}
    busy = r"off old: .*still busy with 'off'"
    with briefly(), pytest.raises(ReconfigError, match=busy):
        arm.swap("old", "good")
    with briefly():
        arm.control("old", "kill")
    assert arm.reconfig(caught.value.rest[1:]) == {"good": "ON"}
    assert states(arm) == {"stays": "ON", "good": "ON", "old": "NOT-CREATED"}
    assert writer(arm) == "good"
    wait_for(lambda: causes(arm) == [], "the end of all causes")
    assert arm.status("stays").on_ns == before.on_ns


def test_who_comes_on_late_takes_nothing_from_who_came_back(
    arm, nodes, write, tmp_path
):
    """An heir, and a fallback: while their `on` hangs the one before is turned on.

    It is on another RTPU, where nobody knows of them.
    """
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    nodes.write_module("waits_in_on", WAITS_IN_ON)
    nodes.write_module("fails", FAILS)
    write("late", "waits_in_on", local={"BEGUN": begun, "GO_ON": go_on})
    write("bad", "fails")
    write("far", "counts")

    def come_back(task):
        wait_for(begun.exists, "its on")
        arm.control(task, "on")
        go_on.touch()
        wait_for(lambda: states(arm)["late"] == "ERROR", "the end of on")
        assert "late cannot write Y0: another task does" in arm.status("late").error
        assert (states(arm)[task], writer(arm)) == ("ON", task)
        wait_for(lambda: not causes(arm), "a legal configuration")

    arm.spawn("late", "arm1")
    arm.control("good", "on")
    successors = m.Successors(after={"late": ["good"]}, timeout=LIMIT)
    calls = arm.clients.call("arm1", successors, dict[str, list[m.Call]])
    off = m.Reconfig(items=[("good", "off")], handover={"good": ["Y0"]}, calls=calls)
    assert arm.clients.call("arm0", off, m.Reconfigured).done == 1
    come_back("good")  # a second order; the master of the first has gone
    arm.control("late", "kill")
    begun.unlink()
    go_on.unlink()

    tasks = "TASK stays arm0\nTASK bad arm0 FALLBACK late"
    (tmp_path / "j.job").write_text(f"JOB j\nDESC\nSBS t.sbs\n{tasks}\nEOF\n")
    arm.swap("good", "far", rtpu="arm1")
    with pytest.raises(ReconfigError, match="bad, which has come on, has failed"):
        arm.switch("j")
    come_back("far")


def test_on_that_ends_when_nobody_waits_takes_nothing_from_others(
    arm, nodes, write, tmp_path, monkeypatch
):
    """The exchange was given up, and the one before is back in its place."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    nodes.write_module("waits_in_on", WAITS_IN_ON)
    write("late", "waits_in_on", local={"BEGUN": begun, "GO_ON": go_on})
    arm.spawn("late", "arm0")
    arm.control("good", "on")
    with monkeypatch.context() as short:
        short.setattr(subsystem_tasks, "CONTROL_TIME", 2.5)
        with pytest.raises(
            ReconfigError, match="on late: the task was not turned on in time"
        ):
            arm.swap("good", "late")
    assert arm.swap("late", "good").items == [("good", "on")]
    go_on.touch()
    wait_for(lambda: states(arm)["late"] == "ERROR", "the end of on")
    assert "late cannot write Y0: another task does" in arm.status("late").error
    assert states(arm) == {"stays": "ON", "good": "ON", "late": "ERROR"}
    assert writer(arm) == "good"
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_off_that_hangs_in_an_exchange(arm, write, briefly):
    """Both on one RTPU: the heir stands by at the dispatcher meanwhile."""
    write("bad", "hangs_in_off", freq=50.0)
    start(arm, "bad")
    before = arm.status("stays")
    with briefly(), pytest.raises(ReconfigError) as caught:
        arm.swap("bad", "good")
    assert (caught.value.done, caught.value.rest) == (
        0,
        (("bad", "off"), ("good", "on")),
    )
    assert "item 1 of 2, off bad" in str(caught.value)
    assert "did not finish 'off'" in str(caught.value)
    assert states(arm) == {"stays": "ON", "bad": "ON", "good": "OFF"}
    assert writer(arm) == "bad"
    assert set(causes(arm)) == {"bad hangs in off (arm0/bad)"}
    with briefly(), pytest.raises(ReconfigError, match="still busy with 'off'"):
        arm.swap("bad", "good")
    with briefly():
        arm.control("bad", "kill")
    assert arm.reconfig(caught.value.rest[1:]) == {"good": "ON"}
    assert writer(arm) == "good"
    assert arm.status("stays").on_ns == before.on_ns


def test_off_in_an_exchange_that_ends_when_nobody_waits_any_more(
    arm, gate, nodes, briefly
):
    """What it was to hand over is given up, so that whoever comes can have it."""
    begun, go_on = gate
    start(arm, "old")
    with briefly(), pytest.raises(ReconfigError) as caught:
        arm.swap("old", "good")
    assert isinstance(caught.value.__cause__, NoAnswerError)
    wait_for(begun.exists, "the beginning of off")
    go_on.touch()
    wait_for(lambda: states(arm)["old"] == "OFF", "the end of off")
    assert states(arm)["good"] == "OFF", "it does not stand by any more"
    wait_for(lambda: causes(arm) == [], "that nothing is said to hang")
    with Table.attach(f"{nodes.domain}.t") as table:
        wait_for(lambda: table.info("Y0").owner is None, "that nobody owns it")
    assert arm.swap("old", "good").items == [("good", "on")], "what is left"
    assert writer(arm) == "good"


def write_with_safe(tmp_path, **settings):
    """Write the RMOD of a task whose every fifth cycle fails in time."""
    text = rmod("overruns", "Y0", 50.0, local=settings)
    text = text.replace("FREQ 50\n", "FREQ 50\nSAFE deadline\n")
    (tmp_path / "bad.rmod").write_text(text)


def value(arm):
    return tuple(arm.display(["Y0"])[0].values)


def test_who_hangs_with_safe_values_leaves_them_to_its_heir(arm, tmp_path, briefly):
    write_with_safe(tmp_path, work="endless")
    start(arm, "bad")
    wait_for(lambda: arm.status("bad").made_safe, "safe values")
    with briefly(), pytest.raises(ReconfigError) as caught:
        arm.swap("bad", "good")
    assert (writer(arm), value(arm)) == ("bad", SAFE)
    with briefly():
        arm.control("bad", "kill")
    assert value(arm) == SAFE, "until somebody else writes"
    assert arm.reconfig(caught.value.rest[1:]) == {"good": "ON"}
    wait_for(lambda: value(arm) != SAFE, "the heir's values")
    assert writer(arm) == "good"
    assert not causes(arm)


def test_a_swap_amid_failures_gives_the_heir_what_nobody_else_writes(arm, tmp_path):
    write_with_safe(tmp_path, busy=0.05, work="sleep")
    start(arm, "bad")
    for count in (1, 2, 3):
        wait_for(lambda n=count: arm.status("bad").made_safe >= n, "safe values")
        arm.swap("bad", "good")
        assert writer(arm) == "good"
        seen = {value(arm) for _ in range(20)}
        assert SAFE not in seen, "a late failure of the other task"
        arm.swap("good", "bad")


@pytest.fixture
def gate(write, tmp_path):
    """A task whose `off` begins and ends with files; returns these."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    write("old", "waits_in_off", local={"BEGUN": begun, "GO_ON": go_on})
    return begun, go_on


class Swapping(threading.Thread):
    """A swap in a thread of its own; keeps what came of it."""

    def __init__(self, arm, old, new):
        super().__init__()
        self._do = lambda: arm.swap(old, new)
        self.result = self.error = None
        self.start()

    def run(self):
        try:
            self.result = self._do()
        except PbonetError as error:
            self.error = error


def test_agent_killed_in_the_middle(arm, gate, nodes):
    begun, go_on = gate
    start(arm, "old")
    tids = {status.task: status.tid for status in arm.status_all()}
    swapping = Swapping(arm, "old", "good")
    wait_for(begun.exists, "the beginning of off")
    agent = nodes.processes.pop("arm0")
    agent.send_signal(signal.SIGKILL)
    agent.wait()
    swapping.join()
    assert isinstance(swapping.error, ReconfigError), swapping.error
    text = str(swapping.error)
    assert "sent, and not known whether done: off old, on good" in text
    go_on.touch()
    nodes.agent_process("arm0")
    wait_for(lambda: states(arm).get("good") == "ON", "the RTPU goes on by itself")
    assert states(arm) == {"stays": "ON", "old": "OFF", "good": "ON"}
    assert {status.task: status.tid for status in arm.status_all()} == tids
    assert arm.swap("old", "good").items == []  # nothing is left to be done
    assert arm.swap("good", "old").items == [("good", "off"), ("old", "on")]
    assert writer(arm) == "old"


def test_two_swaps_at_once(arm, gate, write):
    begun, go_on = gate
    write("third", "counts", out="Y0")
    start(arm, "old")
    first = Swapping(arm, "old", "good")
    wait_for(begun.exists, "the beginning of off")
    second = Swapping(arm, "old", "third")
    go_on.touch()
    first.join()
    second.join()
    assert first.error is None
    assert first.result.states == {"old": "OFF", "good": "ON"}
    assert isinstance(second.error, VerificationError), second.error
    assert "good and third both write Y0" in str(second.error)
    assert states(arm) == {"stays": "ON", "old": "OFF", "good": "ON"}


def test_two_lists_at_once_at_one_agent(arm, gate, write):
    """One that is under way is finished; the other is refused whole, and says why."""
    begun, go_on = gate
    write("third", "counts", out="Y0")
    start(arm, "old")
    arm.spawn("third", "arm0")

    def send(*items):
        return arm.clients.call("arm0", m.Reconfig(items=list(items)), m.Reconfigured)

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(send, ("old", "off"), ("good", "on"))
        try:
            wait_for(begun.exists, "the beginning of off")
            for items in (
                [("old", "off"), ("third", "on")],
                [("stays", "off"), ("old", "off"), ("third", "on")],
            ):
                with pytest.raises(StateError) as caught:
                    send(*items)
                said = str(caught.value)
                assert "another list of subsystem t is being carried out" in said
                assert "off old, on good" in said
            assert states(arm)["stays"] == "ON", "not even the first item was sent"
        finally:
            go_on.touch()
        assert first.result().done == 2
    assert states(arm) == {"stays": "ON", "old": "OFF", "good": "ON", "third": "OFF"}
    assert send(("good", "off"), ("third", "on")).done == 2
    assert writer(arm) == "third"


def test_task_that_dies_while_it_goes_off(arm, gate):
    begun, _ = gate
    start(arm, "old")
    swapping = Swapping(arm, "old", "good")
    wait_for(begun.exists, "the beginning of off")
    tid = arm.status("old").tid
    os.kill(tid, signal.SIGKILL)
    swapping.join()
    assert not alive(tid)
    assert isinstance(swapping.error, ReconfigError), swapping.error
    assert not any("hangs" in cause for cause in causes(arm))
    assert "not sent: on good" in str(swapping.error)
    wait_gone([tid])
    arm.reconfig(swapping.error.rest[1:])
    assert writer(arm) == "good"


def test_an_heir_on_another_rtpu_is_told_of(arm, write, tmp_path):
    write("other", "counts", out="Y0")
    arm.control("good", "on")
    arm.swap("good", "other", rtpu="arm1")
    assert arm.model.find("other").rtpu == "arm1"
    assert (tmp_path / "good.txt").read_text().splitlines()[-1].endswith("off True")
    arm.swap("other", "good")
    arm.control("good", "off")
    assert (tmp_path / "good.txt").read_text().splitlines()[-1].endswith("off False")
