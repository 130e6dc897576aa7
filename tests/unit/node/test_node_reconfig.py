"""Lists of signals on one RTPU whose tasks are played; the tables are real."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest
from msgspec import structs

from pbonet.analysis.schedule.records import Mode
from pbonet.config import parse_svar
from pbonet.config.model import TaskType
from pbonet.errors import PbonetError, TaskDiedError, UnknownTaskError
from pbonet.node.rt import _rt
from pbonet.node.rtpu import reconfig
from pbonet.node.rtpu.handover import Exchange, plan
from pbonet.node.rtpu.illegal_flag import Flags
from pbonet.node.rtpu.rtpu_state import Rtpu as Process
from pbonet.node.rtpu.successors import Successors
from pbonet.node.wire import rtpu_messages
from pbonet.node.wire.event_log import EventLog
from pbonet.pbo import State
from pbonet.svar import Table
from pbonet.xm.net import messages as m

VARIABLE = "NAME {}\nTYPE double\nDESC an output\nUNITS none\nNELEM 1\n\n"
B_HANDS = {"b": ["Y1"]}
LIMIT = 30.0
"""Seconds after which a test has failed."""


class Tables(dict):
    """The open tables of an RTPU process; their files are whole."""

    sound = dict.get
    subsystems = dict.keys


class Played:
    """A task that is ON and does at once what it is told; see `rtpu.reactions`."""

    def __init__(self, rtpu, name, outputs):
        self.rtpu, self.name, self.state = rtpu, name, State.ON
        self.freq, self.busy, self.engaged, self.waiting = 100.0, "", None, None
        self.gone = asyncio.Event()
        slot = rtpu.core.alloc("arm0", name)
        rtpu.core.post(slot, mode=Mode.ON)
        rmod = SimpleNamespace(tasktype=TaskType.PERIODIC)
        self.facts = SimpleNamespace(
            subsystem="arm", name=name, outputs=outputs, slot=slot, rmod=rmod
        )
        rtpu.tasks["arm", name] = self

    async def command(self, what, _make, _limit, **_more):
        if what == "off":
            await self.rtpu.reactions.get(self.name, self.end)()
        return SimpleNamespace(result=([], False))

    async def end(self):
        self.state = State.OFF

    async def die(self):
        del self.rtpu.tasks["arm", self.name]
        self.rtpu.core.free(self.facts.slot)
        self.gone.set()
        msg = "the task ended by itself"
        raise TaskDiedError(msg, where=self.name)


class Rtpu:
    """What lists need of an RTPU process."""

    name, turned_on, call_far = "arm0", 0, None

    def __init__(self, core, table):
        self.core, self.tasks, self.lists, self.reactions = core, {}, {}, {}
        self.tombs, self.handed = {}, []
        self.events = EventLog(self.name)
        opened = SimpleNamespace(table=table, keep=True)
        self.flags = Flags(self.name, Tables(arm=opened), self.events)
        self.fallbacks = SimpleNamespace(
            turn_off=self._turn_off,
            withdraw=self._nothing,
            ready=self._nothing,
            overtaken=lambda _task: None,
        )
        self.successors = Successors(self)

    async def _nothing(self, *_): ...

    async def _turn_off(self, task, make, limit, **_more):
        gone, _ = (await task.command("off", make, limit)).result
        return gone

    def need(self, _subsystem, name):
        if ("arm", name) not in self.tasks:
            msg = "there is no such task"
            raise UnknownTaskError(msg, where=name)
        return self.tasks["arm", name]

    def bury(self, subsystem, name):
        del self.tombs[subsystem, name]

    def of(self, _subsystem):
        return list(self.tasks.values())

    def rank(self, *_): ...

    def settle(self, *_, **_more): ...

    def cycle_of(self, _task):
        return 0


@pytest.fixture
def table(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    text = "".join(VARIABLE.format(name) for name in ("Y0", "Y1")) + "EOF\n"
    table = Table.create("arm", parse_svar(text, "t.svar").variables)
    yield table
    table.destroy()


@pytest.fixture
def rtpu(table, monkeypatch):
    core = _rt.CoreTable(1)
    made = Rtpu(core, table)

    async def control(_rtpu, task, signal, _limit, *, handover, **_more):
        made.handed += [(task.name, signal)] * handover
        await task.command(signal, None, _limit)

    monkeypatch.setattr(reconfig, "control", control)
    yield made
    core.close()


def call(heir, *outputs):
    return m.Call(
        successor=heir,
        outputs=list(outputs),
        core=1,
        slot=9,
        life=1,
        ticket=1,
        caller=0,
    )


def carry_out(rtpu, outputs, calls, items=None, *, handover=None):
    """Turn off tasks whose outputs others take over, all or some; return the answer.

    Nobody takes over, and what is looked at later than at once never is.
    """

    async def run():
        for name, theirs in outputs.items():
            Played(rtpu, name, theirs)
        request = m.Reconfig(
            subsystem="arm",
            items=items or [(name, "off") for name in outputs],
            handover=handover or outputs,
            calls=calls,
        )
        answer = await reconfig.reconfigure(rtpu, request)
        for _ in range(5):
            await asyncio.sleep(0)
        return answer

    return asyncio.run(asyncio.wait_for(run(), LIMIT))


@pytest.mark.parametrize(
    "outputs",
    [{"a": ["Y0"], "b": ["Y1"]}, {"a": ["Y0", "Y1"]}],
    ids=["two that leave", "one that leaves for two"],
)
def test_who_is_not_called_has_the_time_of_a_trip(rtpu, table, monkeypatch, outputs):
    """The heir of Y1 is on another machine: the master has yet to send its `on`."""
    calls = {"a": [call("h", "Y0")]}
    monkeypatch.setattr(reconfig, "TRIP", 3600.0)
    answer = carry_out(rtpu, outputs, calls)
    assert answer.done == len(outputs)
    assert [one.cause.split()[-1] for one in table.illegal] == ["Y0"], "it was called"


def test_who_does_not_come_in_that_time_raises_the_flag(rtpu, table, monkeypatch):
    monkeypatch.setattr(reconfig, "TRIP", 0.0)
    carry_out(rtpu, {"b": ["Y1"]}, {})
    assert [one.cause for one in table.illegal] == [
        "off b is done, and no task took over Y1"
    ]


def test_a_variable_that_nobody_is_to_take_over_is_not_waited_for(
    rtpu, table, monkeypatch
):
    """The heir of b writes less: who has judged the list knows that nobody reads Y0."""
    monkeypatch.setattr(reconfig, "TRIP", 0.0)
    carry_out(rtpu, {"b": ["Y0", "Y1"]}, {}, handover=B_HANDS)
    assert [one.cause for one in table.illegal] == [
        "off b is done, and no task took over Y1"
    ]


def test_who_comes_on_after_one_that_hands_over_goes_on_from_it(rtpu):
    """Not by an exchange: the last one does not leave."""
    outputs = {"a": ["Y0"], "b": ["Y1"], "heir": ["Y0"]}
    items = [("a", "off"), ("heir", "on"), ("b", "on")]
    carry_out(rtpu, outputs, {}, items, handover={"a": ["Y0"]})
    assert rtpu.handed == [("a", "off"), ("heir", "on")]


def test_who_comes_on_after_one_that_an_earlier_part_turned_off_goes_on_from_it(rtpu):
    """The master cuts a list wherever the next item is for another RTPU."""
    outputs = {"heir": ["Y0"], "other": ["Y1"]}
    items = [("heir", "on"), ("other", "on")]
    carry_out(rtpu, outputs, {}, items, handover={"a": ["Y0"]})
    assert rtpu.handed == [("heir", "on")]


def test_who_is_turned_on_first_does_not_go_on_from_what_it_leaves_itself(rtpu):
    outputs = {"a": ["Y0"], "heir": ["Y0"], "b": ["Y1"]}
    items = [("a", "on"), ("a", "off"), ("heir", "on"), ("b", "on")]
    carry_out(rtpu, outputs, {}, items, handover={"a": ["Y0"]})
    assert rtpu.handed == [("a", "off"), ("heir", "on")]


def two_lists(rtpu, *lists):
    """Have b hand Y1 over, and the other task nothing: items and handover of each."""

    async def run():
        for name, outputs in {"b": ["Y1"], "other": ["Y0"]}.items():
            Played(rtpu, name, outputs)
        for items, handover in lists:
            request = m.Reconfig(subsystem="arm", items=items, handover=handover)
            assert (await reconfig.reconfigure(rtpu, request)).done == len(items)
        for _ in range(5):
            await asyncio.sleep(0)

    asyncio.run(asyncio.wait_for(run(), LIMIT))


def test_the_next_list_ends_the_look_at_the_one_before(rtpu, table, monkeypatch):
    """What is handed over is decided anew; a look behind it would say what is over."""
    monkeypatch.setattr(reconfig, "TRIP", 0.0)
    two_lists(rtpu, ([("b", "off")], B_HANDS), ([("other", "off")], {}))
    assert [one.cause for one in table.illegal] == []


def test_the_next_part_of_a_list_ends_no_look(rtpu, table, monkeypatch):
    """The master has died behind it: the heir of Y1, on another RTPU, never comes."""
    monkeypatch.setattr(reconfig, "TRIP", 0.0)
    two_lists(rtpu, ([("b", "off")], B_HANDS), ([("other", "off")], B_HANDS))
    assert [one.cause for one in table.illegal] == [
        "off b is done, and no task took over Y1"
    ]


def test_what_one_list_left_stands_until_the_next_is_done(rtpu, table, monkeypatch):
    monkeypatch.setattr(reconfig, "TRIP", 0.0)
    seen = []

    async def look():
        for _ in range(5):
            await asyncio.sleep(0)
        seen.extend(one.cause for one in table.illegal)
        await rtpu.tasks["arm", "other"].end()

    rtpu.reactions["other"] = look
    two_lists(rtpu, ([("b", "off")], B_HANDS), ([("other", "off")], {}))
    assert seen == ["off b is done, and no task took over Y1"]
    assert [one.cause for one in table.illegal] == []


def test_what_was_done_before_another_one_died_is_answered(rtpu):
    async def dies_meanwhile():
        await rtpu.tasks["arm", "b"].end()
        with pytest.raises(TaskDiedError):
            await rtpu.tasks["arm", "a"].die()

    rtpu.reactions["b"] = dies_meanwhile
    items = [("b", "off"), ("a", "off")]
    outputs = {"a": ["Y0"], "b": ["Y1"]}
    answer = carry_out(rtpu, outputs, {"a": [call("h", "Y0")]}, items)
    assert (answer.done, answer.rest) == (1, [("a", "off")])
    assert answer.states == {"b": "OFF"}
    assert answer.error is not None
    assert "there is no such task" in str(PbonetError.from_wire(answer.error))


def test_what_one_of_two_has_handed_over_in_vain_raises_the_flag(rtpu, table):
    """Both leave for one on another machine, and b fails: nobody calls it for both."""
    msg = "off raised"

    async def fails():
        raise PbonetError(msg)

    rtpu.reactions["b"] = fails
    far = {name: [structs.replace(call("h", "Y0"), far=True)] for name in ("a", "b")}
    answer = carry_out(rtpu, {"a": ["Y0"], "b": ["Y1"]}, far)
    assert (answer.done, answer.rest) == (1, [("b", "off")])
    assert [one.cause for one in table.illegal] == [
        "off a is done, and no task took over Y0"
    ]


def test_a_variable_that_a_task_does_not_write_is_not_handed_over(rtpu, table):
    """The list is carried out, and the answer says so; nothing is waited for."""
    answer = carry_out(rtpu, {"b": []}, {}, handover={"b": ["NONE", "Y1"]})
    assert (answer.done, answer.error) == (1, None)
    assert table.illegal == []
    assert not rtpu.flags.waits.is_set()


def test_more_than_can_call_one_successor_are_exchanged_one_by_one(rtpu):
    """A ticket has room for so many callers."""

    async def run(many):
        for k in range(many):
            Played(rtpu, f"t{k}", ["Y0"])
        Played(rtpu, "new", ["Y0"]).state = State.OFF
        items = [(f"t{k}", "off") for k in range(many)]
        return len(plan(rtpu, "arm", [*items, ("new", "on")], {}))

    assert asyncio.run(run(m.MOST_CALLERS)) == m.MOST_CALLERS + 1
    assert asyncio.run(run(m.MOST_CALLERS + 1)) == 0


def test_a_task_that_has_died_is_killed_in_a_list(rtpu):
    """It may have died amid the list; every other signal to it fails."""
    rtpu.tombs["arm", "dead"] = "its last status"
    items = [("dead", "kill"), ("b", "off"), ("dead", "off")]
    answer = carry_out(rtpu, {"b": ["Y1"]}, {}, items)
    assert (answer.done, answer.rest) == (2, [("dead", "off")])
    assert answer.states == {"dead": "NOT-CREATED", "b": "OFF"}
    assert rtpu.tombs == {}


def test_an_exchange_is_slow_though_one_of_its_tasks_is_dead(rtpu):
    async def run():
        slow = asyncio.Event()
        dead = Played(rtpu, "dead", ["Y0"])
        Played(rtpu, "hangs", ["Y1"])
        rtpu.reactions |= {"dead": dead.die, "hangs": slow.wait}
        calls = {name: [call("h", "Y0")] for name in ("dead", "hangs")}
        after = {"dead": [], "hangs": []}
        exchange = Exchange(rtpu, "arm", after, LIMIT, calls)
        await exchange.run(slow.set)
        return exchange.failed

    assert list(asyncio.run(asyncio.wait_for(run(), LIMIT))) == ["dead"]


def test_an_exchange_that_fails_gives_variables_up_first(rtpu, monkeypatch):
    """Who stands by may have been engaged all the same: it finds them free then."""
    monkeypatch.setattr("pbonet.node.rtpu.handover.TRIP", 0.0)
    done = []

    class Fails(Played):
        """Its `on` has failed when it is known to stand by."""

        async def command(self, what, make, limit, **more):
            done.append((what, self.name))
            if what == "prepare":
                error = PbonetError("on raised").to_wire()
                notice = rtpu_messages.Notice(
                    severity=40, code="ENGAGED", text="", error=error
                )
                self.engaged.set_result(notice)
            return await super().command(what, make, limit, **more)

    async def spare(task):
        done.append(("spare", task.name))

    rtpu.fallbacks.spare = spare

    async def run():
        Fails(rtpu, "old", ["Y0"])
        Fails(rtpu, "new", ["Y0"]).state = State.OFF
        exchange = Exchange(rtpu, "arm", {"old": [], "new": ["old"]}, LIMIT)
        await exchange.run(lambda: None)
        return exchange.failed

    assert list(asyncio.run(asyncio.wait_for(run(), LIMIT))) == ["new"]
    assert done == [
        ("prepare", "new"),
        ("off", "old"),
        ("disown", "old"),
        ("spare", "new"),
        ("rest", "new"),
    ]


def test_a_death_is_marked_before_it_is_judged_who_counts_on_the_task(rtpu):
    """A caller that came just before the mark was told that the heir is there."""
    core, judged = rtpu.core, []
    slot = core.alloc("arm0", "heir")
    life = core.expect(slot, 7, 2)
    core.post(slot, mode=Mode.STANDS)

    def died(one):
        assert core.call(one, life, 7, 0)
        core.died(one)
        assert not core.call(one, life, 7, 1)

    nothing = lambda *_: None  # noqa: E731 - as short as what it does
    facts = SimpleNamespace(subsystem="arm", slot=slot)
    process = SimpleNamespace(
        core=SimpleNamespace(died=died, snapshot=core.snapshot, free=core.free),
        signals=SimpleNamespace(end=nothing),
        fallbacks=SimpleNamespace(update=nothing),
        warnings=SimpleNamespace(end=nothing),
        _timing_failures=SimpleNamespace(report_end=nothing),
        tasks={},
        told={},
        spawned={},
        _died=lambda _task, _code, seen: judged.append((seen.dead, seen.called)),
        **dict.fromkeys(
            ("status_of", "rank", "save", "_reap", "now_ns", "unwatch_life"), nothing
        ),
    )
    task = SimpleNamespace(name="heir", facts=facts, stopping=False)
    Process.ended(process, task, -9)
    assert judged == [(True, True)]
    assert core.slots() == []
