"""When a standby takes over from a task on another RTPU, and what is ordered first."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pbonet.errors import NoAnswerError
from pbonet.node.restart import Takeovers
from pbonet.node.wire.rtpu_messages import OpenTable, Standby, TakeOver
from pbonet.xm.net import session

SILENT = session.SILENT_MS * 1e-3
LONG = 100.0
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
        self.done, self.fails, self.ids = [], set(), []
        self.meanwhile = lambda: None
        self.reach = ["arm2", "arm3"]
        self.ended = set()
        signs = SimpleNamespace(
            is_seen=lambda name: name not in self.silent,
            is_here=lambda name: name == "arm1",
            absence=lambda *_: self.alone,
        )
        orders = SimpleNamespace(
            add=lambda order: self.done.append(("kept", order.tasks)),
            in_reach=lambda: self.reach,
            has_ended=lambda name: name in self.ended,
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

    def call_all(self, requests, _result, *, timeout):
        assert timeout > 0
        for name, order in requests.items():
            self.done.append((name, order.tasks))
            self.ids.append(order.stop_id)
        self.meanwhile()
        return {}, [NoAnswerError("no", where=n) for n in requests if n in self.fails]

    def turns(self, begin, end):
        """Let time pass in turns of 0.1 s."""
        for turn in range(round(begin * 10), round(end * 10) + 1):
            self.watch.turn(turn / 10)

    def met(self, *on, name="arm0", stops=(), where="arm1"):
        """Take a greeting, of an agent that knows stops not carried out at `where`."""
        due = {where: [("s1", subsystem) for subsystem in stops]}
        self.watch.met(SimpleNamespace(name=name, on={"t": [*on]}, due=due))


@pytest.fixture
def world():
    return World()


ORDER = {"arm0": ["first"]}
TOLD = TakeOver("t", "second", "no task has written its variables for 3 s")


def cut(world):
    world.silent.add("arm0")
    world.written, world.alone = False, LONG


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


def test_an_original_that_comes_back_is_judged_anew(world):
    """The keeper was not reached at the order; later another loss is another order."""
    cut(world)
    world.fails.add("arm2")
    world.turns(0, 3)
    assert world.done == [("arm2", ORDER)]
    world.fails.clear()
    world.silent.clear()
    world.written, world.alone = True, 0.0
    world.turns(3.1, 3600)
    assert world.done == [("arm2", ORDER)], "it runs, and is not turned off"
    cut(world)
    world.turns(3600.1, 3603)
    assert world.done == [("arm2", ORDER)], "TAKEOVER counts from the new loss"
    world.turns(3603.1, 3603.2)
    assert world.done[-1] == TOLD
    first, *later = world.ids
    assert len({*later}) == 1
    assert first not in later, "what was carried out once has no effect again"


def test_one_that_has_obeyed_meanwhile_is_lost_from_then_on(world):
    """The keeper has the order, though its answer was lost."""
    cut(world)
    world.fails.add("arm2")
    world.turns(0, 3)
    world.fails.clear()
    world.silent.clear()
    world.written, world.alone = True, 0.0
    world.turns(3.1, 4)
    world.met()
    world.written = False
    world.turns(4.1, 7)
    assert TOLD not in world.done
    world.turns(7.1, 7.2)
    assert world.done[-1] == TOLD


def test_one_that_comes_back_while_the_keeper_answers_is_not_replaced(world):
    cut(world)
    world.meanwhile = world.silent.clear
    world.turns(0, 3.5)
    assert world.done == [("arm2", ORDER), ("kept", ORDER), ("arm3", ORDER)]


def test_one_that_was_heard_between_two_turns_is_lost_from_then_on(world):
    """A turn takes long where the keeper does not answer."""
    cut(world)
    world.fails.add("arm2")
    world.turns(0, 3)
    world.fails.clear()
    world.alone = 1.0
    world.watch.turn(6.0)
    world.alone = 2.9
    world.watch.turn(7.9)
    assert world.done == [("arm2", ORDER)]
    world.alone = 3.0
    world.watch.turn(8.0)
    assert world.done[-1] == TOLD


def test_an_rtpu_that_has_ended_on_a_machine_that_goes_on_is_lost(world):
    """Its agent has given up, and another agent of that machine is heard."""
    cut(world)
    world.alone = 0.0
    world.turns(0, 20)
    assert world.done == [], "its process may go on without its agent"
    world.ended.add("arm0")
    world.turns(20.1, 23.2)
    assert world.done[-1] == TOLD


@pytest.mark.parametrize("who", ["arm0", "arm2", "arm3"])
@pytest.mark.parametrize("subsystem", ["t", ""])
def test_what_was_stopped_is_not_lost(world, who, subsystem):
    """The stop is known to some agent, and has not arrived here yet."""
    world.met("first")
    world.met(name=who, stops=[subsystem])
    cut(world)
    world.turns(0, 20)
    assert world.done == []
    world.met(name=who)
    world.turns(20.1, 23.2)
    assert world.done[-1] == TOLD


@pytest.mark.parametrize("other", [{"stops": ["u"]}, {"stops": ["t"], "where": "arm2"}])
def test_a_stop_that_does_not_concern_the_standby_is_none(world, other):
    world.met(**other)
    world.written = False
    world.turns(0, 3)
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


def test_one_that_came_back_from_an_orderly_end_can_be_lost(world):
    """Its agent has restarted, such as for other keys, and the tasks went on."""
    world.watch.ended("arm0")
    world.met()
    cut(world)
    world.turns(0, 10)
    assert world.done == [], "the agent was started again, with nothing"
    world.met("first")
    world.turns(10.1, 13.2)
    assert world.done[-1] == TOLD


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
