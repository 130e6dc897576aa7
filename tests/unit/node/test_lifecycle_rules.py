"""The rules as data: what is valid where, what refusals say, what is drawn."""

import importlib.util
from pathlib import Path

import pytest

from pbonet.errors import StateError
from pbonet.node.task.step_failures import ABOUT_ELEMENT, ALL_REFUSED, REFUSED
from pbonet.node.wire import lifecycle
from pbonet.node.wire.lifecycle import RULES, Event, Failure, Step
from pbonet.pbo import State
from pbonet.svar.result_codes import Flags

DOCS = Path(__file__).parents[3] / "docs"


def test_what_is_valid_in_each_state():
    assert lifecycle.valid(State.NOT_CREATED) == [Event.SPAWN]
    assert lifecycle.valid(State.OFF) == [
        Event.ON,
        Event.KILL,
        Event.REINIT,
        Event.SET,
        Event.GET,
    ]
    assert lifecycle.valid(State.ON) == [
        Event.WAKEUP,
        Event.SYNC,
        Event.ABORT,
        Event.OFF,
        Event.KILL,
        Event.REINIT,
        Event.SET,
        Event.GET,
    ]
    assert lifecycle.valid(State.ERROR) == [
        Event.KILL,
        Event.CLEAR,
        Event.REINIT,
        Event.SET,
        Event.GET,
    ]


REFUSALS = [
    (State.ON, Event.ON, "off or kill or reinit", "; it is ON already"),
    (State.OFF, Event.OFF, "on or kill or reinit", "; it is OFF already"),
    (State.OFF, Event.CLEAR, "on or kill or reinit", "; it has no error"),
    (
        State.ERROR,
        Event.ON,
        "kill or clear or reinit",
        "; remove the cause of its error, then send clear",
    ),
    (State.NOT_CREATED, Event.ON, "spawn", ""),
]


@pytest.mark.parametrize(("state", "event", "expected", "remedy"), REFUSALS)
def test_an_event_that_is_not_valid_is_refused(state, event, expected, remedy):
    with pytest.raises(StateError) as caught:
        lifecycle.rule(state, event, where="arm0/law")
    assert str(caught.value) == (
        f"arm0/law: signal {event} is not valid in state {state} "
        f"(expected {expected}, got {event}){remedy}"
    )


def test_only_signals_of_a_master_are_signals():
    assert lifecycle.signal_event("kill") is Event.KILL
    for name in ("wakeup", "spawn", "cler"):
        with pytest.raises(StateError, match="no such signal"):
            lifecycle.signal_event(name)
    with pytest.raises(StateError, match=r"did you mean clear\?"):
        lifecycle.signal_event("cler")


def test_every_rule_can_be_obeyed():
    for rule in RULES.values():
        methods = [step for step in rule.steps if step.is_method]
        assert methods
        assert not rule.answers or len(methods) == 1
        assert rule.failure is Failure.ERROR or not rule.resume
        assert set(rule.resume) <= set(rule.steps)


def test_the_flags_are_those_of_the_table():
    assert Flags(ALL_REFUSED) == (
        Flags.COPY_LOST
        | Flags.COMMIT_NONFINITE
        | Flags.COMMIT_LIMIT
        | Flags.COMMIT_NOT_OWNER
        | Flags.TABLE_OVERWRITTEN
    )
    assert {Flags(bit) for bit in REFUSED} >= {Flags(bit) for bit in ABOUT_ELEMENT}
    about = Flags.COMMIT_NONFINITE | Flags.COMMIT_LIMIT
    assert Flags(sum(ABOUT_ELEMENT)) == about


@pytest.fixture(scope="module")
def drawing():
    spec = importlib.util.spec_from_file_location(
        "draw_lifecycle", DOCS / "draw_lifecycle.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_documentation_is_in_step_with_the_rules(drawing):
    page = (DOCS / "lifecycle.md").read_text()
    assert drawing.inserted(page) == page, "run: python docs/draw_lifecycle.py"
    figure = (DOCS / "lifecycle.svg").read_text()
    assert drawing.figure() == figure, "run: python docs/draw_lifecycle.py"


def test_another_rule_changes_the_documentation(drawing, monkeypatch):
    page, figure = (DOCS / "lifecycle.md").read_text(), drawing.figure()
    rule = lifecycle.Rule(steps=(Step.OFF_METHOD,), to=State.OFF, failure=Failure.ERROR)
    monkeypatch.setitem(RULES, (State.ERROR, Event.OFF), rule)
    assert drawing.inserted(page) != page
    assert drawing.figure() != figure
