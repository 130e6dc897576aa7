"""When a standby takes over from a task on another RTPU, and what is ordered first."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from pbonet.errors import NoAnswerError
from pbonet.node.restart import Takeovers
from pbonet.node.wire.rtpu_messages import OpenTable, Standby, TakeOver
from pbonet.xm.net import session

SILENT = session.SILENT_MS * 1e-3
STANDBY = Standby(
    subsystem="t",
    standby="second",
    original="first",
    rtpu="arm0",
    takeover=3.0,
    outputs=("Y",),
)


class World:
    """Everything that the watch of arm1 sees, and what it does; arm2 has the keeper."""

    def __init__(self, keeper="arm2"):
        self.silent, self.alone, self.written = set(), 0.0, True
        self.done, self.fails = [], set()
        self.reach = ["arm2", "arm3"]
        signs = SimpleNamespace(
            is_silent=self.silent.__contains__, absence=self._absence
        )
        orders = SimpleNamespace(
            add=lambda order: self.done.append(("kept", order.tasks)),
            in_reach=lambda: self.reach,
        )
        self.watch = Takeovers(
            "arm1", self, signs, orders,
            written=lambda _subsystem, _names: self.written,
            send=self.done.append,
        )  # fmt: skip
        self.update(STANDBY, keeper=keeper)

    def update(self, *standbys, keeper="arm2"):
        tables = {"t": OpenTable(keep=False, keeper=keeper, alone=1.0)}
        info = SimpleNamespace(standbys=[*standbys], tables=tables)
        self.watch.update(info)

    def _absence(self, name, _keeper):
        return math.inf if name == "arm1" else self.alone

    def call_all(self, requests, _result, *, timeout):
        assert timeout > 0
        for name, order in requests.items():
            self.done.append((name, order.tasks))
        return {}, [NoAnswerError("no", where=n) for n in requests if n in self.fails]

    def turns(self, begin, end):
        """Let time pass in turns of 0.1 s."""
        for turn in range(round(begin * 10), round(end * 10) + 1):
            self.watch.turn(turn / 10)

    def met(self, *on):
        self.watch.met(SimpleNamespace(name="arm0", on={"t": [*on]}))


@pytest.fixture
def world():
    return World()


ORDER = {"arm0": ["first"]}
TOLD = TakeOver("t", "second", "no task has written its variables for 3 s")


def cut(world):
    world.silent.add("arm0")
    world.written, world.alone = False, SILENT


def test_the_keeper_and_all_others_have_the_order_before(world):
    cut(world)
    world.turns(0, 2.9)
    assert world.done == []
    world.turns(3, 3)
    steps = [("arm2", ORDER), ("kept", ORDER), ("arm3", ORDER)]
    assert world.done == [*steps, TOLD]


def test_where_the_keeper_is_here_nobody_is_needed():
    world = World(keeper="arm1")
    cut(world)
    world.fails |= {"arm2", "arm3"}
    world.turns(0, 3)
    assert world.done == [("kept", ORDER), ("arm2", ORDER), ("arm3", ORDER), TOLD]


def test_without_the_keepers_answer_nothing_is_done_and_it_is_asked_again(world):
    cut(world)
    world.fails.add("arm2")
    world.turns(0, 3.5)
    assert world.done == [("arm2", ORDER)]
    world.fails.clear()
    world.turns(3.6, 4.1)
    assert world.done[1:3] == [("arm2", ORDER), ("kept", ORDER)]
    assert world.done[-1] == TOLD


def test_what_was_begun_is_finished_once_the_original_has_obeyed(world):
    """It came back after the keeper had the order."""
    cut(world)
    world.fails.add("arm2")
    world.turns(0, 3)
    world.fails.clear()
    world.silent.clear()
    world.written, world.alone = True, 0.0
    world.turns(3.1, 5)
    assert TOLD not in world.done
    world.written = False
    world.turns(5.1, 6.2)
    assert world.done[-1] == TOLD


@pytest.mark.parametrize(
    "alone", [0.0, SILENT / 2], ids=["the keeper hears it", "not for long enough"]
)
def test_a_machine_that_others_hear_is_not_lost(world, alone):
    cut(world)
    world.alone = alone
    world.turns(0, 20)
    assert world.done == []


def test_time_counts_without_a_break(world):
    cut(world)
    world.turns(0, 2.9)
    world.written = True
    world.turns(3, 3)
    world.written = False
    world.turns(3.1, 6)
    assert world.done == []
    world.turns(6.1, 6.2)
    assert world.done[-1] == TOLD


def test_a_task_that_is_not_on_is_lost_though_its_rtpu_is_seen(world):
    """It has failed, or its RTPU process was killed: an order would have been told."""
    world.met("first")
    world.written = False
    world.turns(0, 10)
    assert world.done == [], "its RTPU says that it is ON"
    world.met()
    world.turns(10.1, 13.1)
    assert world.done[-1] == TOLD


def test_an_rtpu_that_ended_in_order_is_not_lost(world):
    world.watch.ended("arm0")
    cut(world)
    world.turns(0, 10)
    assert world.done == []


def test_who_does_not_stand_by_any_more_is_left_alone(world):
    cut(world)
    world.turns(0, 2)
    world.update(STANDBY)
    world.turns(2.1, 3)
    assert world.done[-1] == TOLD, "the same one is watched on"
    world.done.clear()
    world.update()
    world.turns(3.1, 20)
    assert world.done == []
