"""The life of a task as data (Stewart 1994, sections 3.5, 3.6, 4.5.3, Figure 3.10).

`RULES` lists, for every state and every signal that is valid in it, the steps to take:
copies between the local and the global table, and methods of the module. `ANSWERED`
lists the consequences of the answers of `error`. `pbonet.node.task.executor` follows
these tables, ``docs/lifecycle.md`` is generated from them, and no other code decides
about states.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from msgspec import Struct

from pbonet.errors import StateError, did_you_mean
from pbonet.pbo import Answer, State


class Event(StrEnum):
    """Events of a task; all but `WAKEUP`, `SYNC` and `ABORT` are sent to it."""

    SPAWN = "spawn"
    ON = "on"
    WAKEUP = "wakeup"
    """The timer, or the return of `sync`."""
    SYNC = "sync"
    """A synchronous or aperiodic task is about to wait for its event."""
    ABORT = "abort"
    """A handler of timing failures has ended the cycle (section 6.3)."""
    OFF = "off"
    KILL = "kill"
    CLEAR = "clear"
    REINIT = "reinit"
    SET = "set"
    GET = "get"


class Step(StrEnum):
    """One step of a task: a copy, or a method of the module."""

    COPY_IN_CONSTS = "in-consts in"
    COPY_OUT_CONSTS = "out-consts out"
    COPY_IN = "in-vars in"
    COPY_IN_ON = "in-vars and out-vars in"
    COPY_IN_AGAIN = "in-vars and out-vars in again"
    """The same for a task that owns its out-vars and keeps them."""
    CLAIM = "out-vars out, own"
    """Out-vars are copied out and owned by the task: one event for all others."""
    COMMIT = "out-vars out"
    RELEASE = "disown"
    """Out-vars keep their values and have no owner; no effect if they have none."""
    INIT = "init"
    ON_METHOD = "on"
    CYCLE = "cycle"
    """Or `stable`, for a CRITICAL task while the illegal-configuration flag is up."""
    OFF_METHOD = "off"
    KILL = "kill"
    CLEAR = "clear"
    REINIT = "reinit"
    SYNC = "sync"
    SET = "set"
    GET = "get"

    @property
    def is_method(self) -> bool:
        """Whether it is a method of the module and not a copy."""
        return self not in _COPIES


_COPIES = frozenset({
    Step.COPY_IN_CONSTS,
    Step.COPY_OUT_CONSTS,
    Step.COPY_IN,
    Step.COPY_IN_ON,
    Step.COPY_IN_AGAIN,
    Step.CLAIM,
    Step.COMMIT,
    Step.RELEASE,
})


class Failure(StrEnum):
    """The consequence of a failed step of a rule."""

    KILL = "kill"
    """`kill` runs, and the task is NOT-CREATED."""
    ERROR = "error"
    """`error` is called; see `ANSWERED`."""
    REPORT = "report"
    """The failure is reported and the state does not change."""
    GO_ON = "go on"
    """The failure is reported, and the task still enters the rule's end state."""


class Outcome(Struct, frozen=True):
    """The consequence of one answer of a method: steps, and an end state.

    After an answer of `error` the end state is reached even if a step fails.
    """

    steps: tuple[Step, ...]
    to: State


class Rule(Struct, frozen=True, kw_only=True):
    """The consequence of one event in one state."""

    steps: tuple[Step, ...]
    to: State
    """The state after the last step."""
    failure: Failure
    """Of any step but `kill`, whose failure is reported and has no consequence."""
    answers: Mapping[Answer | None, Outcome | None] = {}
    """Answers that the method may return: an outcome ends the rule, None continues."""
    resume: tuple[Step, ...] = ()
    """Steps on the way to `to` after a failure that `error` answers with CONTINUE."""
    answered: Mapping[Answer, Outcome] = {}
    """The consequences of other answers of `error` that differ from `ANSWERED`."""


_ENDED = Outcome((Step.RELEASE, Step.KILL), State.NOT_CREATED)
_REINIT = (Step.COPY_IN_CONSTS, Step.REINIT, Step.COPY_OUT_CONSTS)


def _reinit(state: State, failure: Failure) -> Rule:
    resume = (Step.COPY_OUT_CONSTS,) if failure is Failure.ERROR else ()
    return Rule(steps=_REINIT, to=state, failure=failure, resume=resume)


RULES: Mapping[tuple[State, Event], Rule] = {
    (State.NOT_CREATED, Event.SPAWN): Rule(
        steps=(Step.COPY_IN_CONSTS, Step.INIT, Step.COPY_OUT_CONSTS),
        to=State.OFF,
        failure=Failure.KILL,
    ),
    (State.OFF, Event.ON): Rule(
        steps=(Step.COPY_IN_ON, Step.ON_METHOD, Step.CLAIM),
        to=State.ON,
        failure=Failure.ERROR,
        answers={None: None, Answer.OFF: Outcome((), State.OFF)},
        resume=(Step.CLAIM,),
    ),
    (State.ON, Event.WAKEUP): Rule(
        steps=(Step.COPY_IN, Step.CYCLE, Step.COMMIT),
        to=State.ON,
        failure=Failure.ERROR,
    ),
    (State.ON, Event.SYNC): Rule(
        steps=(Step.SYNC,), to=State.ON, failure=Failure.ERROR
    ),
    (State.ON, Event.ABORT): Rule(
        steps=(Step.COPY_IN_AGAIN, Step.ON_METHOD),
        to=State.ON,
        failure=Failure.ERROR,
        answers={None: None, Answer.OFF: Outcome((Step.RELEASE,), State.OFF)},
    ),
    (State.ON, Event.OFF): Rule(
        steps=(Step.OFF_METHOD, Step.COMMIT, Step.RELEASE),
        to=State.OFF,
        failure=Failure.ERROR,
        resume=(Step.COMMIT, Step.RELEASE),
    ),
    (State.ON, Event.KILL): Rule(
        steps=(Step.OFF_METHOD, Step.COMMIT, Step.RELEASE, Step.KILL),
        to=State.NOT_CREATED,
        failure=Failure.ERROR,
        resume=(Step.COMMIT, Step.RELEASE, Step.KILL),
        answered={Answer.OFF: _ENDED, Answer.ERROR: _ENDED},
    ),
    (State.OFF, Event.KILL): Rule(
        steps=(Step.KILL,), to=State.NOT_CREATED, failure=Failure.GO_ON
    ),
    (State.ERROR, Event.KILL): Rule(
        steps=(Step.KILL,), to=State.NOT_CREATED, failure=Failure.GO_ON
    ),
    (State.ERROR, Event.CLEAR): Rule(
        steps=(Step.CLEAR,),
        to=State.OFF,
        failure=Failure.REPORT,
        answers={Answer.OFF: None, Answer.ERROR: Outcome((), State.ERROR)},
    ),
    (State.OFF, Event.REINIT): _reinit(State.OFF, Failure.ERROR),
    (State.ON, Event.REINIT): _reinit(State.ON, Failure.ERROR),
    (State.ERROR, Event.REINIT): _reinit(State.ERROR, Failure.REPORT),
    **{
        (state, event): Rule(steps=(step,), to=state, failure=Failure.REPORT)
        for state in (State.OFF, State.ON, State.ERROR)
        for event, step in ((Event.SET, Step.SET), (Event.GET, Step.GET))
    },
}
"""The rule of each state and event; an event without a rule is not valid there."""


ANSWERED: Mapping[Answer, Outcome] = {
    Answer.OFF: Outcome((Step.RELEASE,), State.OFF),
    Answer.ERROR: Outcome((Step.RELEASE,), State.ERROR),
}
"""The consequences of OFF and ERROR; CONTINUE leads to the rule's own `resume`."""


NOT_MADE = Outcome((Step.KILL,), State.NOT_CREATED)
"""The consequence of a failed `init`; `error` is not called."""


def outcome(found: Rule, answer: Answer) -> Outcome:
    """Return the consequence if `error` answers OFF or ERROR to a failure in a rule."""
    return found.answered.get(answer) or ANSWERED[answer]


FROM_OUTSIDE = (Event.ON, Event.OFF, Event.KILL, Event.CLEAR, Event.REINIT)
"""Signals that a master sends to an existing task (section 4.5.3)."""


def valid(state: State) -> list[Event]:
    """Return the events that are valid in `state`, in the order of `Event`."""
    return [event for event in Event if (state, event) in RULES]


def rule(state: State, event: Event, *, where: str = "") -> Rule:
    """Return the rule of `event` in `state`.

    Raises:
        StateError: The event is not valid in this state; the task ignores it.
    """
    found = RULES.get((state, event))
    if found is not None:
        return found
    signals = [one for one in valid(state) if one in FROM_OUTSIDE]
    raise StateError(
        f"signal {event} is not valid in state {state}",
        where=where,
        expected=" or ".join(signals) or "spawn",
        got=event,
        remedy=_REMEDIES.get((state, event), ""),
    )


def signal_event(name: str, *, where: str = "") -> Event:
    """Return the event of the signal `name`, as a master sends it.

    Raises:
        StateError: There is no such signal.
    """
    for event in FROM_OUTSIDE:
        if event == name:
            return event
    raise StateError(
        "no such signal",
        where=where,
        expected=" or ".join(FROM_OUTSIDE),
        got=name,
        remedy=did_you_mean(name, FROM_OUTSIDE),
    )


_REMEDIES: Mapping[tuple[State, Event], str] = {
    (State.ON, Event.ON): "it is ON already",
    (State.OFF, Event.OFF): "it is OFF already",
    (State.ERROR, Event.ON): "remove the cause of its error, then send clear",
    (State.ERROR, Event.OFF): "it does not cycle; send clear or kill",
    (State.OFF, Event.WAKEUP): "turn it on first",
    (State.OFF, Event.CLEAR): "it has no error",
    (State.ON, Event.CLEAR): "it has no error",
}


def table() -> str:
    """Return `RULES` as a Markdown table, for the documentation."""
    lines = [
        "| in state | on | the task does | and then is | if that fails |",
        "|---|---|---|---|---|",
    ]
    for (state, event), found in RULES.items():
        steps = " → ".join(_step_text(step) for step in found.steps)
        lines.append(
            f"| {state} | {event} | {steps} | {_ends(found)} | {_failing(found)} |"
        )
    return "\n".join(lines) + "\n"


def _step_text(step: Step) -> str:
    return f"**{step}**" if step.is_method else str(step)


def _ends(found: Rule) -> str:
    ends = [str(found.to)]
    ends += [f"{_way(e)} if it answers {a}" for a, e in found.answers.items() if e]
    return ", ".join(ends)


def _failing(found: Rule) -> str:
    if found.failure is Failure.KILL:
        return _way(NOT_MADE)
    if found.failure is Failure.REPORT:
        return "reported; the state stays"
    if found.failure is Failure.GO_ON:
        return f"reported → {found.to}"
    ways = [f"{answer}: {_way(outcome(found, answer))}" for answer in ANSWERED]
    steps = "".join(f"{_step_text(step)} → " for step in found.resume)
    ways.append(f"{Answer.CONTINUE}: {steps}{found.to}")
    return "**error** answers " + "; ".join(ways)


def _way(after: Outcome) -> str:
    return " → ".join([*map(_step_text, after.steps), str(after.to)])


def arrows() -> dict[tuple[State, State], list[str]]:
    """Return the transitions between states, for the documentation's figure."""
    found: dict[tuple[State, State], list[str]] = {}
    for (state, event), one in RULES.items():
        if one.to is not state or event is Event.WAKEUP:
            found.setdefault((state, one.to), []).append(str(event))
    for (state, event), one in RULES.items():
        ends = {f"{event}: {a}": end.to for a, end in one.answers.items() if end}
        if one.failure is Failure.ERROR:
            ends |= {f"error: {answer}": outcome(one, answer).to for answer in ANSWERED}
        for label, end in ends.items():
            if end in {state, State.NOT_CREATED}:
                continue
            labels = found.setdefault((state, end), [])
            if label not in labels:
                labels.append(label)
    return found
