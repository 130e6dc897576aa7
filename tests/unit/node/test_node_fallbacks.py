"""A fallback that hands over to its own original stands by for it behind its `off`."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from pbonet.analysis.schedule.records import Mode
from pbonet.errors import MethodError, NoAnswerError
from pbonet.node.rtpu import signal_tasks
from pbonet.node.rtpu.fallbacks import LIMIT, Fallbacks
from pbonet.node.wire import rtpu_messages
from pbonet.node.wire.event_log import EventLog
from pbonet.pbo import State

ORIGINAL, STANDBY, OTHER = "first", "second", "other"


class Core:
    """What the dispatcher is told of slots, and says of them."""

    def __init__(self):
        self.follows = {}
        self.fell = set()
        self.dead = set()
        self.coming = set()

    def follow(self, slot, slots):
        self.follows[slot] = slots

    def snapshot(self, slot):
        return SimpleNamespace(
            mode=Mode.OFF,
            fell=slot in self.fell,
            dead=slot in self.dead,
            comes=slot in self.coming,
        )


class FakeTask:
    """A task that obeys, or fails as it is told."""

    def __init__(self, name, slot, state):
        self.name = name
        self.facts = SimpleNamespace(subsystem="arm", slot=slot, outputs=["Y"])
        self.state = state
        self.stands_by, self.waiting = "", None
        self.stopping = False
        self.coming = []
        self.gone = asyncio.Event()
        self.heard = []
        self.fails_off = None
        self.fails_prepare = False

    async def command(self, what, make, limit, *, last=False, **_more):
        assert limit > 0
        assert last is (what == "off")
        message = make(1)
        self.heard.append(message)
        stands = False
        if isinstance(message, rtpu_messages.Signal):
            self._off()
            stands = message.then is not None and not self.fails_prepare
        return rtpu_messages.Done(n=1, state=self.state, result=([], stands))

    def _off(self):
        if self.fails_off is not None:
            raise self.fails_off
        self.state = State.OFF


class Home:
    """An RTPU with the two, and the predecessors of the first."""

    def __init__(self):
        self.name = "arm0"
        self.core = Core()
        self.events = EventLog("arm0")
        self.first = FakeTask(ORIGINAL, 3, State.OFF)
        self.second = FakeTask(STANDBY, 4, State.ON)
        self.tasks = {("arm", one.name): one for one in (self.first, self.second)}
        self.stopping = set()
        self.lists = {}
        self.successors = SimpleNamespace(dismiss=lambda _task: None)
        self.fallbacks = Fallbacks(self)
        asyncio.run(self.fallbacks.pair("arm", STANDBY, ORIGINAL))

    def publish_claims(self):
        self.told = self.fallbacks.away()

    def of(self, subsystem):
        return [one for (of, _), one in self.tasks.items() if of == subsystem]

    def need(self, subsystem, name):
        return self.tasks[subsystem, name]

    def turn_off(self, *callers):
        """Turn the standby off, while its original waits for these."""
        self.first.waiting = SimpleNamespace(after=list(callers))

        def off(n, then):
            return rtpu_messages.Signal(n, "off", handover=True, cede=True, then=then)

        return asyncio.run(self.fallbacks.turn_off(self.second, off, 5.0, last=True))

    @property
    def prepared(self):
        """What the standby was told to be ready for, message by message."""
        heard = [getattr(one, "then", one) for one in self.second.heard]
        messages = [one for one in heard if one is not None]
        return [(one.after, one.owners) for one in messages]


@pytest.fixture
def home():
    return Home()


def stands_by(home):
    return home.second.stands_by, home.core.follows.get(4)


READY = (ORIGINAL, [3])
ALONE = ("", [])


def test_its_off_says_what_it_stands_by_for(home):
    assert home.turn_off(STANDBY, OTHER) == []
    assert home.second.state == State.OFF
    assert home.prepared == [([ORIGINAL], [STANDBY, OTHER])]
    assert stands_by(home) == READY


@pytest.mark.parametrize(
    "why", ["another", "fell", "dead", "on", "gone", "often", "ended"]
)
def test_nothing_is_arranged_where_it_could_not_be_engaged_in_order(home, why):
    callers = [OTHER] if why == "another" else [STANDBY]
    if why == "fell":
        home.core.fell.add(3)
    elif why == "dead":
        home.core.dead.add(3)
    elif why == "on":
        home.first.state = State.ON
    elif why == "gone":
        del home.tasks["arm", ORIGINAL]
    elif why == "ended":
        home.first.stopping = True
    elif why == "often":
        home.fallbacks._pairs["arm", STANDBY].engaged = LIMIT
    home.turn_off(*callers)
    assert home.prepared == []
    assert [type(one) for one in home.second.heard] == [rtpu_messages.Signal]
    assert stands_by(home) == ("", None)


@pytest.mark.parametrize(
    "error", [NoAnswerError("it hangs in off"), MethodError("off raised")], ids=repr
)
def test_an_off_that_fails_leaves_it_as_it_was(home, error):
    home.second.fails_off = error
    with pytest.raises(type(error)):
        home.turn_off(STANDBY)
    assert stands_by(home) == ALONE
    assert home.prepared[-1] == ([], []), "in case that it gets ready yet"


def test_one_within_its_on_takes_nothing_from_who_comes_on(home):
    home.second.stands_by = ORIGINAL
    home.fallbacks.overtaken(home.first)
    assert 4 not in home.core.follows, "it stands by and is not engaged"
    home.core.coming.add(4)
    home.fallbacks.overtaken(home.second)
    assert 4 not in home.core.follows, "it is the one that comes on"
    home.fallbacks.overtaken(home.first)
    assert stands_by(home) == (ORIGINAL, [])


def test_one_that_cannot_get_ready_is_off_all_the_same(home):
    home.second.fails_prepare = True
    home.turn_off(STANDBY)
    assert home.second.state == State.OFF
    assert stands_by(home) == ALONE
    assert home.prepared[-1] == ([], [])


def test_of_one_that_has_died_no_slot_is_touched(home):
    """It may be another task's by then."""
    home.second.fails_off = NoAnswerError("it has died")
    home.second.gone.set()
    with pytest.raises(NoAnswerError):
        home.turn_off(STANDBY)
    assert stands_by(home) == ("", [3])
    assert home.prepared == [([ORIGINAL], [STANDBY])]


@pytest.fixture
def restless(home):
    """The RTPU: while a standby is sent to rest, it looks at all pairs once more."""
    third = home.tasks["arm", "third"] = FakeTask("third", 5, State.OFF)
    home.first.state, home.second.state = State.ON, State.OFF

    async def obeys(task, what, make):
        task.heard.append(make(1))
        if what == "rest":
            home.fallbacks.update_all()
        await turns()

    for task in (home.second, third):
        task.command = lambda what, make, _limit, task=task: obeys(task, what, make)
    return home


async def turns():
    """Let everything run that is due."""
    for _ in range(10):
        await asyncio.sleep(0)


def test_a_pair_that_is_ended_is_not_arranged_once_more(restless):
    async def run():
        await restless.fallbacks.pair("arm", STANDBY, ORIGINAL)
        assert stands_by(restless) == READY
        await restless.fallbacks.pair("arm", STANDBY, "")
        await turns()

    asyncio.run(run())
    assert stands_by(restless) == ALONE
    assert restless.prepared[-1] == ([], [])
    assert restless.fallbacks.of(restless.second) is None


def test_nobody_gets_ready_again_for_a_task_that_is_killed(restless, monkeypatch):
    """It has two fallbacks: while one is sent to rest, the other one's time comes."""
    home, third = restless, restless.tasks["arm", "third"]
    pairs = home.fallbacks
    left = []

    async def killed(*_, **_more):
        of = home.core.follows
        left.extend((t.stands_by, of[t.facts.slot]) for t in (home.second, third))
        return []

    monkeypatch.setattr(signal_tasks, "kill", killed)

    async def run():
        await pairs.pair("arm", STANDBY, ORIGINAL)
        await pairs.pair("arm", "third", ORIGINAL)
        assert home.second.stands_by == third.stands_by == ORIGINAL
        await signal_tasks.control(home, home.first, "kill", 5.0)

    asyncio.run(run())
    assert left == [ALONE, ALONE]


def test_what_a_fallback_does_not_write_is_not_missed(home):
    """The configuration was judged with it in the place of the task that has failed."""
    home.first.facts.outputs = ["X", "Y"]
    assert home.fallbacks.missed(home.first) == ["Y"]
    del home.tasks["arm", STANDBY]
    assert home.fallbacks.missed(home.first) == ["X", "Y"]


AWAY = {"rtpu": "arm9", "takeover": 3.0}


def away(home, **more):
    """Have the second, OFF, stand by for a task of another RTPU."""
    home.second.state = State.OFF
    asyncio.run(home.fallbacks.pair("arm", STANDBY, "far", **{**AWAY, **more}))
    return [(one.original, one.rtpu, one.takeover, one.outputs) for one in home.told]


def test_the_agent_watches_the_original_of_another_rtpu(home):
    assert away(home) == [], "it is not ON yet"
    assert not home.fallbacks.stands_away(home.second)
    assert away(home, ready=True) == [("far", "arm9", 3.0, ("Y",))]
    assert home.fallbacks.stands_away(home.second)
    home.second.state = State.ERROR
    home.fallbacks.update(home.second)
    assert home.told == []
    assert away(home, ready=True, takeover=0.0) == [], "only by an order"
    assert home.fallbacks.stands_away(home.second)
    assert stands_by(home) == ("", None), "the dispatcher knows nothing of it"


def test_it_takes_over_three_times_and_is_made_ready_by_a_master_each_time(
    home, monkeypatch
):
    signals, fails = [], [None]

    async def control(_rtpu, task, signal, _limit):
        signals.append((task.name, signal))
        if fails[0]:
            raise fails[0]
        task.state = State.ON

    def take_over():
        away(home, ready=True)
        order = rtpu_messages.TakeOver("arm", STANDBY, "why")
        asyncio.run(signal_tasks.take_over(home, order))
        return home.events.since(0)[-1].text

    monkeypatch.setattr(signal_tasks, "control", control)
    assert take_over() == (
        "far on arm9 is lost, why: its fallback second was turned on; state ON, time 1 "
        "of 3"
    )
    assert home.told == []
    order = rtpu_messages.TakeOver("arm", STANDBY, "again")
    asyncio.run(signal_tasks.take_over(home, order))
    assert len(signals) == 1, "it is not ready"
    fails[0] = NoAnswerError("no", where=STANDBY)
    assert "state OFF, time 2 of 3: " in take_over()
    assert "time 3 of 3" in take_over()
    home.fallbacks.takes_over(home.second)
    assert not home.fallbacks.stands_away(home.second)


def test_a_task_that_was_replaced_is_turned_off_or_killed(home, monkeypatch):
    signals = []

    async def control(_rtpu, task, signal, _limit):
        signals.append((task.name, signal))
        if task is home.first and signal == "off":
            raise MethodError("off has failed", where=task.name)
        task.state = State.OFF

    monkeypatch.setattr(signal_tasks, "control", control)
    home.first.state = home.second.state = State.ON
    off = FakeTask(OTHER, 5, State.OFF)
    tasks = [home.first, home.second, off]
    done = asyncio.run(signal_tasks.replaced(home, tasks, 2.0))
    assert (done.off, done.killed) == ([STANDBY], [ORIGINAL])
    wanted = [(ORIGINAL, "off"), (ORIGINAL, "kill"), (STANDBY, "off")]
    assert signals == wanted


@pytest.mark.parametrize("ends", [True, False], ids=["it comes", "its on hangs"])
def test_a_task_that_is_being_turned_on_when_it_is_replaced_does_not_stay_on(
    home, monkeypatch, ends
):
    """Its state is OFF until its `on` has ended."""
    task, begun = FakeTask(OTHER, 5, State.OFF), []
    started, go_on = asyncio.Event(), asyncio.Event()
    home.tasks["arm", OTHER] = task

    async def withdraw(_task):
        pass

    home.rank = lambda _task: None
    home.successors.withdraw = withdraw

    async def command(what, _make, _limit, **_more):
        begun.append(what)
        started.set()
        if what == "on":
            await go_on.wait()
        task.state = State.ON if what == "on" else State.OFF

    async def killed(*_, **_more):
        begun.append("kill")
        go_on.set()
        return []

    async def run():
        coming = asyncio.create_task(signal_tasks.control(home, task, "on", 5.0))
        await started.wait()
        limit = 60.0 if ends else 0.0
        order = asyncio.create_task(signal_tasks.replaced(home, [task], limit))
        if ends:
            await asyncio.sleep(0)
            go_on.set()
        done = await order
        await coming
        return done

    task.command = command
    monkeypatch.setattr(signal_tasks, "kill", killed)
    monkeypatch.setattr(signal_tasks, "note", lambda *_: None)
    done = asyncio.run(run())
    if ends:
        assert (done.off, begun, task.state) == ([OTHER], ["on", "off"], State.OFF)
    else:
        assert (done.killed, begun[-1]) == ([OTHER], "kill")
