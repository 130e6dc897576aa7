"""Successors on other machines: what is asked for, and when the agent calls."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import msgspec
import pytest
from test_master_sending import ITEMS, Fleet, model
from test_node_reconfig import Rtpu, call, carry_out, rtpu, table

from pbonet.errors import TaskDiedError
from pbonet.master.subsystem.send_signal_list import send
from pbonet.node.mirror import remote_handover
from pbonet.node.rtpu import successors
from pbonet.node.rtpu.successors import Successors
from pbonet.node.rtpu.task_handle import Waiting
from pbonet.pbo import State

__all__ = ["model", "rtpu", "table"]
TICKET = 77


@pytest.fixture
def waiting(rtpu):
    """A slot whose task waits for one call, and that call, packed."""
    slot = rtpu.core.alloc("arm1", "heir")
    life = rtpu.core.expect(slot, TICKET, 1)
    made = msgspec.structs.replace(
        call("heir", "Y0"), slot=slot, life=life, ticket=TICKET, far=True
    )
    yield made
    rtpu.core.free(slot)


def awaited(rtpu, one):
    return rtpu.core.expects(one.slot, one.life, one.ticket, one.caller)


def test_an_heir_is_called_once(rtpu, table, waiting):
    (data,) = remote_handover.packed([waiting])
    assert remote_handover.make(table, data, 0)
    assert not awaited(rtpu, waiting)
    assert not remote_handover.make(table, data, 0)


@pytest.mark.parametrize(
    "wrong",
    [{"ticket": 78}, {"core": 9}, {"caller": 1}, {"outputs": ["NOT_THERE"]}],
    ids=str,
)
def test_a_call_to_somebody_else_is_not_heard(rtpu, table, waiting, wrong):
    """All machines get it; one has the successor."""
    (data,) = remote_handover.packed([msgspec.structs.replace(waiting, **wrong)])
    assert not remote_handover.make(table, data, 0)
    assert not remote_handover.make(table, data[:-1], 0)
    assert awaited(rtpu, waiting)


@pytest.mark.parametrize("late_ns", [remote_handover.LATEST_NS + 1, None])
def test_a_call_that_may_have_been_under_way_for_long_is_not_made(
    rtpu, table, waiting, late_ns
):
    """None: the clock of the machine that it comes from is not known."""
    (data,) = remote_handover.packed([waiting])
    assert not remote_handover.make(table, data, late_ns)
    assert awaited(rtpu, waiting)
    assert remote_handover.make(table, data, remote_handover.LATEST_NS), (
        "it stands by all the same"
    )


def test_nobody_is_called_while_another_one_writes(rtpu, table, waiting):
    (data,) = remote_handover.packed([waiting])
    with table.local("other", 1, outvar=["Y0"]) as other:
        other.claim()
        assert not remote_handover.make(table, data, 0)
        assert awaited(rtpu, waiting)
        other.release()
    assert remote_handover.make(table, data, 0)


class Away(Rtpu):
    """An RTPU that notes whom it has others call, and what its tasks were told."""

    def __init__(self, core, table):
        super().__init__(core, table)
        self.called = []

    def call_far(self, subsystem, calls):
        self.called.append((subsystem, [one.successor for one in calls]))


def far(heir, *outputs):
    return msgspec.structs.replace(call(heir, *outputs), far=True)


def test_the_heirs_of_those_that_have_ended_are_called(rtpu, table):
    away = Away(rtpu.core, table)
    outputs = {"a": ["Y0"], "b": ["Y1"]}
    calls = {"a": [far("h", "Y0"), far("i", "Y0")], "b": [far("h", "Y1")]}
    assert carry_out(away, outputs, calls).done == 2
    assert away.called == [("arm", ["h", "i", "h"])]
    assert not table.illegal, "they have the time of a trip"


def test_the_heirs_of_one_that_fails_are_not(rtpu, table):
    away = Away(rtpu.core, table)

    async def fail():
        raise TaskDiedError("the task ended by itself", where="a")

    away.reactions = {"a": fail}
    outputs = {"a": ["Y0"], "b": ["Y1"]}
    answer = carry_out(away, outputs, {"a": [far("h")], "b": [far("i")]})
    assert answer.rest == [("a", "off")]
    assert away.called == [("arm", ["i"])]


class Apart(Fleet):
    """RTPUs on machines of their own, which have one host name."""

    def __init__(self, beside="none"):
        super().__init__()
        self.beside = beside
        """An RTPU that shares a machine with that of the successor."""

    def agent(self, rtpu):
        machine = "arm2" if rtpu == self.beside else rtpu
        return SimpleNamespace(machine=machine, host="robot")


def test_a_master_has_heirs_on_other_machines_stand_by(model):
    fleet = Apart()
    items = [("a", "off"), ("both", "on")]
    assert send(model, fleet, items, 1.0) == {"a": "OFF", "both": "ON"}
    (first, heir), (second, off), (third, on) = fleet.sent
    assert (first, heir.after, heir.far) == ("arm2", {"both": ["a"]}, ["a"])
    assert (second, list(off.calls)) == ("arm0", ["a"])
    assert (third, on.items) == ("arm2", [("both", "on")])


@pytest.mark.parametrize(
    ("beside", "far"), [("none", ["a", "b"]), ("arm1", ["a"])], ids=["far", "mixed"]
)
def test_a_successor_of_tasks_on_two_machines_stands_by(model, beside, far):
    """Both leave at the same time; one may be on the successor's own machine."""
    fleet = Apart(beside)
    send(model, fleet, ITEMS, 1.0)
    (first, successors), together, (_, one), (_, other), (last, _) = fleet.sent
    assert (first, successors.after) == ("arm2", {"both": ["a", "b"]})
    assert successors.far == far
    assert together == ("at once", ["arm0", "arm1"])
    assert (list(one.calls), list(other.calls)) == (["a"], ["b"])
    assert last == "arm2"


def waits_for(rtpu, one):
    """Return the successors of an RTPU, and one that waits for that call."""
    loop = asyncio.get_running_loop()
    task = SimpleNamespace(
        name="heir", state=State.OFF, engaged=loop.create_future(),
        facts=SimpleNamespace(subsystem="arm", outputs=["Y0"], slot=one.slot),
    )  # fmt: skip
    timer = loop.call_later(3600.0, int)
    task.waiting = Waiting(["old"], [one], timer)
    return Successors(rtpu), task


def test_its_on_has_an_heir_engaged_whom_nobody_has_called(rtpu, waiting):
    async def ask():
        made, task = waits_for(rtpu, waiting)
        return await made.asked(task), task.waiting is not None

    assert asyncio.run(ask()) == (True, True)
    assert not awaited(rtpu, waiting)


def test_its_on_is_judged_as_any_while_another_one_writes(
    rtpu, table, waiting, monkeypatch
):
    rested = []

    async def rest(_rtpu, task):
        rested.append(task.name)

    monkeypatch.setattr(successors, "rest", rest)

    async def ask():
        made, task = waits_for(rtpu, waiting)
        return await made.asked(task), task.waiting is not None

    with table.local("other", 1, outvar=["Y0"]) as other:
        other.claim()
        assert asyncio.run(ask()) == (False, False)
        assert awaited(rtpu, waiting)
        other.release()
    assert rested == ["heir"]
