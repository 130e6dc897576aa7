"""The overload example's eyes and judgement, on traces of the rules in virtual time."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from plain_dispatcher.dispatch import Dispatcher
from plain_dispatcher.inputs import pack

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision, Kind, Mode
from pbonet.analysis.schedule.simulate import PeriodicTask, simulate

EXAMPLE = Path(__file__).parents[3] / "examples" / "overload"
BEGIN = 1_800_000_000
CRITS = {
    "MUF": {"tau1": 5, "tau2": 5, "tau3": 5, "tau4": 3},
    "RM": {"tau1": 29, "tau2": 23, "tau3": 21, "tau4": 18},
    "EDF": dict.fromkeys(("tau1", "tau2", "tau3", "tau4"), 5),
}
ARMED = Mode.ON | 1 << 2


@pytest.fixture
def example(monkeypatch):
    """The example's modules, found as its demo finds them."""
    import sys

    monkeypatch.syspath_prepend(str(EXAMPLE))
    import judged
    import seen

    yield seen, judged
    for name in ("judged", "seen"):
        sys.modules.pop(name, None)


class Machine:
    """A core that does what the rules decide, but for the time when it is away.

    Args:
        seen: The example's module.
        sets: Period and cost of each task, ns, by name.
        crits: Their criticalities.
        away: Begin and end of the time in which nobody runs.
    """

    def __init__(self, seen, sets, crits, away=(0, 0)):
        self.seen, self.sets, self.away = seen, sets, away
        self.names = dict(enumerate(sets))
        self.cycles = {name: [] for name in sets}
        self.trace, self.inputs = [], []
        self.twin = Dispatcher()
        self.left, self.start = {}, {}
        self.due = 0
        for slot, (name, (period, _)) in enumerate(sets.items()):
            kind = pack(crits[name], 0, Kind.PERIODIC)
            self.inputs += [
                Decision(Event.LIFE, slot, 1, 0, 0),
                Decision(Event.CONFIG, slot, kind, period, 0),
                Decision(Event.MODE, slot, ARMED, 0, 0),
            ]

    def turn(self, now):
        decisions, self.due = self.twin.turn(now, self.inputs)
        self.trace.append(Decision(Event.TURN, 0, 0, now, self.due))
        self.trace += [*self.inputs, *decisions]
        self.inputs = []
        for one in decisions:
            if one.kind == Event.WAKE:
                self.left[one.slot] = self.sets[self.names[one.slot]][1]
        self.work(now)

    def work(self, now):
        """Let the most urgent ones run until the next turn."""
        ready = sorted(self.left, key=lambda slot: -self.twin.slots[slot].level)
        for slot in ready:
            if slot not in self.start:
                now = self.skip(now)
                if now >= self.due:
                    return
                self.start[slot] = now
                self.inputs.append(Decision(Event.BEGUN, slot, 0, 0, 0))
            now = self.spend(slot, now)

    def skip(self, now):
        begin, end = self.away
        return end if begin <= now < end else now

    def spend(self, slot, now):
        """Let a task run until its cycle ends, or the next turn; return when."""
        while self.left[slot] and (now := self.skip(now)) < self.due:
            until = self.away[0] if now < self.away[0] < self.due else self.due
            used = min(self.left[slot], until - now)
            self.left[slot] -= used
            now += used
        if not self.left[slot]:
            self.end(slot, now)
        return now

    def end(self, slot, now):
        name, state = self.names[slot], self.twin.slots[slot]
        begin = self.start.pop(slot)
        cycle = self.seen.Cycle(state.rel_ns, begin, now, self.sets[name][1])
        self.cycles[name].append(cycle)
        del self.left[slot]
        self.inputs = [
            one for one in self.inputs if (one.kind, one.slot) != (Event.BEGUN, slot)
        ]
        self.inputs.append(Decision(Event.DONE, slot, 0, 0, 0))

    def run(self, end):
        self.turn(BEGIN - 1_000_000)
        while self.due <= end:
            self.inputs.sort(key=lambda one: one.slot)
            self.turn(max(self.due, self.skip(self.due)))
        return self.seen.history(self.trace, self.names, self.cycles)


@pytest.fixture
def history(example):
    """Return the history of a burst."""
    seen, judged = example

    def make(scheduler, away=(0, 0), share=0.96):
        unit = judged.UNIT_NS
        sets = {
            name: (period * unit, round(share * cost * unit))
            for name, (period, cost) in judged.TASKS.items()
        }
        begin, end = (BEGIN + round(at * unit) if at else 0 for at in away)
        machine = Machine(seen, sets, CRITS[scheduler], (begin, end))
        return machine.run(BEGIN + 240 * unit), machine

    return make


def burst(judged):
    return BEGIN, BEGIN + 240 * judged.UNIT_NS


@pytest.mark.parametrize("scheduler", ["MUF", "RM", "EDF"])
def test_what_is_seen_is_what_the_simulator_says(example, history, scheduler):
    _, judged = example
    found, machine = history(scheduler)
    begin, end = burst(judged)
    tasks = [
        PeriodicTask(name=name, period_ns=p, cost=c, crit=CRITS[scheduler][name])
        for name, (p, c) in machine.sets.items()
    ]
    virtual = simulate(tasks, until_ns=end - begin)
    for name, account in virtual.tasks.items():
        missed = [at - begin for at in found.missed(name, begin, end)]
        assert missed == account.misses_ns, name
    real = [
        (one.task, one.begin_ns - begin, one.end_ns - begin) for one in found.stretches
    ]
    wanted = [(one.task, one.start_ns, one.end_ns) for one in virtual.segments]
    assert _merged(real) == _merged(wanted)
    judgement = judged.judge(found, scheduler, [(begin, end)])
    assert (judgement.misses, judgement.faults) == ([], [])


def _merged(stretches):
    merged = []
    for task, begin, end in stretches:
        if merged and merged[-1][0] == task and merged[-1][2] == begin:
            merged[-1] = (task, merged[-1][1], end)
        else:
            merged.append((task, begin, end))
    return merged


def test_a_miss_is_excused_by_a_core_that_was_away(example, history):
    _, judged = example
    found, _ = history("MUF", away=(7.5, 10.5))
    judgement = judged.judge(found, "MUF", [burst(judged)])
    assert {miss.task for miss in judgement.misses} <= {"tau1", "tau2", "tau3"}
    assert judgement.misses
    assert all(miss.away_ns > judged.UNIT_NS for miss in judgement.misses)
    assert judgement.faults == []
    found, _ = history("MUF", away=(7.5, 8.4))  # what every stretch has to spare
    assert judged.judge(found, "MUF", [burst(judged)]).misses == []


def test_a_miss_of_a_task_that_had_the_core_is_a_fault(example, history):
    _, judged = example
    found, _ = history("EDF")
    judgement = judged.judge(found, "MUF", [burst(judged)])
    assert "tau2 missed, though it had the core" in judgement.faults
    assert judgement.idle == ["burst 1: tau4 missed nothing"]


def test_an_overload_that_hits_nobody_is_a_fault(example, history):
    _, judged = example
    found, _ = history("MUF", share=0.5)
    judgement = judged.judge(found, "MUF", [burst(judged)])
    assert judgement.faults == ["burst 1: tau4 missed nothing"]


def test_a_decision_against_the_rules_is_found(example, history):
    seen, _ = example
    _, machine = history("MUF")
    place = next(i for i, one in enumerate(machine.trace) if one.kind == Event.LEVEL)
    one = machine.trace[place]
    machine.trace[place] = Decision(one.kind, one.slot, one.arg - 1, one.a, one.b)
    with pytest.raises(ValueError, match="the rules do not decide so"):
        seen.history(machine.trace, machine.names, machine.cycles)


def test_releases_that_tasks_take_themselves_stand_between_two_turns(example):
    """A turn learns of all at once; one of them had to wait for the cycle before it."""
    seen, _ = example
    cycles = {
        "a": [seen.Cycle(100, 101, 135, 30), seen.Cycle(200, 201, 230, 30)],
        "b": [seen.Cycle(130, 136, 150, 10)],
    }
    slots = {
        0: SimpleNamespace(period=100, seq=0, rank=5),
        1: SimpleNamespace(period=500, seq=0, rank=3),
    }
    inputs = [Decision(Event.DONE, 0, 2, 200, 0), Decision(Event.DONE, 1, 1, 130, 0)]
    made = seen._own_releases(
        seen.History([], cycles, [], []),
        SimpleNamespace(slots=slots),
        {0: "a", 1: "b"},
        inputs,
    )
    found = [
        (
            turn.now_ns,
            turn.ready[0].task,
            turn.ready[0].number,
            turn.ready[0].deadline_ns,
        )
        for turn, _ in made
    ]
    assert found == [(100, "a", 1, 200), (135, "b", 1, 630), (200, "a", 2, 300)]
    assert [crits for _, crits in made] == [{"a": 5}, {"b": 3}, {"a": 5}]
