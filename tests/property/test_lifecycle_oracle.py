"""The executor against an oracle that knows only the thesis's text."""

import itertools
from collections import deque
from collections.abc import Callable
from typing import ClassVar

import msgspec
import pytest
from hypothesis import given, settings, strategies as st
from oracle_lifecycle import ABORT, MEANWHILE, METHODS, SIGNALS, Note, Oracle, Ports
from oracle_probe import OracleProbe, Told

from pbonet.errors import MethodError, StateError
from pbonet.node.task.executor import Executor
from pbonet.node.wire import lifecycle
from pbonet.pbo import CycleAborted, State, TaskContext, bind
from pbonet.testing import BenchTable

PORTS = OracleProbe.__interface__.ports


class QuickProbe(OracleProbe):
    """The probe, told and heard in memory."""

    told: ClassVar[dict[str, str]] = {}
    heard: ClassVar[list[Note]] = []
    ending: ClassVar[list[Callable[[], None]]] = []
    """What happens meanwhile, when a handler ends the next cycle."""

    def cycle(self, dt):
        super().cycle(dt)
        if self.ending:
            self.ending[0]()
            raise CycleAborted

    def script(self):
        return self.told

    def note(self, entry):
        self.heard.append(Note(*entry))


class InOneThread:
    """A task that the executor runs here, over tables that are plain arrays."""

    def __init__(self):
        self.table = BenchTable(PORTS, {port.attr: () for port in PORTS}, deque())
        self.make()

    def make(self):
        for array in self.table.local.values():
            array[...] = 0
        task = TaskContext("probe")
        probe = bind(QuickProbe, Told(folder="none"), self.table.local, task)
        self.executor = Executor(probe, self.table)

    def write(self, c_in, x):
        self.table.globals["c_in"][...] = c_in
        self.table.globals["x"][...] = x

    def send(self, signal, script):
        """Return whether it was refused, and whether it failed."""
        QuickProbe.told = script
        QuickProbe.heard = []
        if signal == "spawn" and self.executor.state is State.NOT_CREATED:
            self.make()
        before, failure = self.executor.state, self.executor.failure
        try:
            self.act(signal)
        except StateError:
            return True, False
        except MethodError:
            return False, True
        if self.executor.state is State.ON or before is not State.ON:
            return False, False
        if signal == ABORT:
            return False, self.executor.failure is not failure
        return False, signal in {"cycle", "sync"}

    def act(self, signal):
        executor = self.executor
        if signal == "spawn":
            if executor.state is not State.NOT_CREATED:
                raise StateError("there is a task already")
            executor.spawn()
        elif signal == "cycle":
            executor.cycle(0.01)
        elif signal == ABORT:
            self.abort()
        elif signal == "sync":
            executor.sync()
        elif signal == "set":
            executor.set("gain", ("2.5",))
        else:
            executor.signal(signal)

    def abort(self):
        QuickProbe.told = {k: v for k, v in QuickProbe.told.items() if k != "cycle"}
        QuickProbe.ending = [self.meanwhile]
        try:
            self.executor.cycle(0.01)
        finally:
            QuickProbe.ending = []

    def meanwhile(self):
        self.table.globals["x"][...] += MEANWHILE

    @property
    def state(self):
        return str(self.executor.state)

    def notes(self):
        return QuickProbe.heard

    def values(self):
        return Ports(**{attr: int(a[0]) for attr, a in self.table.globals.items()})


def compare(task, oracle, steps):
    """Return where task and oracle part, "" if they never do."""
    for count, (signal, script) in enumerate(steps):
        c_in, x = 10_000 + count, 20_000 + count
        oracle.table.c_in, oracle.table.x = c_in, x
        task.write(c_in, x)
        expected = oracle.send(signal, script)
        ended = task.send(signal, script)
        got = [*ended, task.notes(), task.values(), task.state, task.table.owned]
        wanted = [expected.refused, expected.failed, expected.notes, oracle.table]
        wanted += [oracle.state, oracle.state == "ON"]
        if got != wanted:
            return f"step {count}, {signal} {script}: {got} where {wanted} must be"
    return ""


WAYS = st.sampled_from(["", "raise", "fail", "OFF", "CONTINUE", "ERROR"])
ANSWERS = st.sampled_from(["OFF", "CONTINUE", "ERROR", "raise"])
SCRIPTS = st.builds(
    lambda script, answer: {**script, "error": answer},
    st.dictionaries(st.sampled_from(METHODS), WAYS, max_size=3),
    ANSWERS,
)
"""Anything any method may do, good or bad."""
STEPS = st.tuples(st.sampled_from([*SIGNALS, ABORT]), st.one_of(st.just({}), SCRIPTS))


@settings(max_examples=500, deadline=None)
@given(st.lists(STEPS, max_size=30))
def test_any_sequence_of_signals_does_what_the_thesis_says(steps):
    assert not compare(InOneThread(), Oracle(), [("spawn", {}), *steps])


FEW = [
    {},
    {"on": "raise", "cycle": "fail", "sync": "raise", "off": "fail", "error": "OFF"},
    {"on": "fail", "cycle": "raise", "sync": "fail", "off": "raise", "error": "ERROR"},
    {
        "on": "raise",
        "cycle": "fail",
        "off": "raise",
        "kill": "fail",
        "error": "CONTINUE",
    },
    {"reinit": "raise", "error": "CONTINUE"},
    {"reinit": "raise", "error": "OFF"},
    {"on": "OFF", "clear": "ERROR", "reinit": "fail", "kill": "raise", "set": "raise"},
    {"init": "raise"},
]
WALKS = [
    ["spawn", "on", "cycle", "cycle", "reinit", "set", "off", "reinit", "on", "cycle"],
    ["spawn", "on", "sync", "kill", "spawn", "kill", "spawn", "set", "clear", "on"],
    ["spawn", "on", "on", "off", "off", "cycle", "on", "reinit", "clear", "kill"],
    ["spawn", "on", "cycle", ABORT, "cycle", ABORT, "off", ABORT, "on", "cycle"],
]
"""With every script in FEW at every step, this walks through each rule."""


def walks():
    """Yield the walks, with each script at each step; errors end in clear or kill."""
    for walk in WALKS:
        yield [(signal, {}) for signal in walk]
        for place, script in itertools.product(range(len(walk)), FEW):
            told = [(signal, {}) for signal in walk]
            told[place] = (walk[place], script)
            after = [("reinit", script), ("clear", script)]
            after += [("clear", {})] * (place % 2)
            yield [*told[: place + 1], *after, ("kill", script), *told[place + 1 :]]


def first_difference():
    differences = (compare(InOneThread(), Oracle(), steps) for steps in walks())
    return next(filter(None, differences), "")


def test_the_fixed_walks_agree():
    assert not first_difference()


def mutants():
    """Yield each rule with one step left out, another end, or other answers."""
    for (state, event), rule in lifecycle.RULES.items():
        if event in {lifecycle.Event.SET, lifecycle.Event.GET}:
            continue  # pinned by the last test
        for kind in ("steps", "resume"):
            steps = getattr(rule, kind)
            for place, step in enumerate(steps):
                less = (*steps[:place], *steps[place + 1 :])
                yield f"{state} {event} {kind} no {step}", state, event, {kind: less}
        for end in State:
            if end is not rule.to and event is not lifecycle.Event.WAKEUP:
                yield f"{state} {event} to {end}", state, event, {"to": end}
        for answer, after in rule.answered.items():
            for less in [after.steps[1:], after.steps[:-1]]:
                other = lifecycle.Outcome(less, after.to)
                change = {"answered": {**rule.answered, answer: other}}
                yield f"{state} {event} {answer} only {less}", state, event, change
            change = {k: v for k, v in rule.answered.items() if k is not answer}
            name = f"{state} {event} {answer} as ever"
            yield name, state, event, {"answered": change}
        if rule.answers:
            deaf = dict.fromkeys(rule.answers)
            yield f"{state} {event} deaf", state, event, {"answers": deaf}
        yield from misled(state, event, rule.answers)


def misled(state, event, answers):
    """Yield a rule's answers with one step less, or with another end."""
    for answer, after in answers.items():
        if after is None:
            continue
        wrong = [(after.steps, end) for end in State if end is not after.to]
        wrong += [(after.steps[:-1], after.to)] if after.steps else []
        for steps, end in wrong:
            other = {**answers, answer: lifecycle.Outcome(steps, end)}
            name = f"{state} {event} {answer} then {[*steps]} {end}"
            yield name, state, event, {"answers": other}


MUTANTS = list(mutants())


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant[0] for mutant in MUTANTS])
def test_the_oracle_sees_any_fault_in_the_rules(monkeypatch, mutant):
    _, state, event, change = mutant
    wrong = msgspec.structs.replace(lifecycle.RULES[state, event], **change)
    monkeypatch.setitem(lifecycle.RULES, (state, event), wrong)
    assert first_difference()


ANSWERED = [
    (answer, change)
    for answer, outcome in lifecycle.ANSWERED.items()
    for change in [
        {"steps": ()},
        *({"to": end} for end in State if end is not outcome.to),
    ]
]


@pytest.mark.parametrize(("answer", "change"), ANSWERED)
def test_the_oracle_sees_any_fault_in_what_follows_error(monkeypatch, answer, change):
    wrong = msgspec.structs.replace(lifecycle.ANSWERED[answer], **change)
    monkeypatch.setitem(lifecycle.ANSWERED, answer, wrong)
    assert first_difference()


def test_rules_that_the_executor_takes_for_granted():
    assert lifecycle.RULES[State.ON, lifecycle.Event.WAKEUP].to is State.ON
    for event in (lifecycle.Event.SET, lifecycle.Event.GET):
        for state in (State.OFF, State.ON, State.ERROR):
            rule = lifecycle.RULES[state, event]
            assert [str(step) for step in rule.steps] == [str(event)]
            assert rule.to is state
            assert rule.failure is lifecycle.Failure.REPORT
