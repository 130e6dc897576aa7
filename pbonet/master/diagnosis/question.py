"""Questions of a user, read from words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.errors import StateError, did_you_mean
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .facts import Facts

_USES = "flag, a task, a variable, an RTPU, 'start [JOB]', or 'miss TASK [CYCLE]'"


class Question(Struct, frozen=True, kw_only=True):
    """A question: what is to be explained."""

    kind: str
    """As in `Explanation`; empty: a name that the facts must tell."""
    name: str = ""
    cycle: int = 0
    """Of a miss: which cycle; 0: any."""
    trace: float = 0.0
    """Of a miss: seconds for which it is followed who has the core."""

    def resolved(self, facts: Facts) -> Question:
        """Return the question with its kind.

        A name that a task and a variable share means the task.

        Raises:
            StateError: Nothing has that name, or a cycle is asked of no recorded run.
        """
        if self.kind == "miss" and self.name not in facts.tasks():
            raise _unknown(f"no task {self.name}", self.name, facts.tasks(), facts)
        if self.cycle and not facts.from_log:
            raise StateError(
                "only a recorded run has the single cycles of a task",
                expected="a log or its folder, or 'miss TASK' without a cycle",
                got=f"miss {self.name} {self.cycle}",
                remedy=f"ask the log, as in 'pbonet explain runs/RUN miss {self.name} "
                f"{self.cycle}', or leave the cycle out",
            )
        if self.kind:
            return self
        rtpus = [one.name for one in facts.graph.rtpus]
        names = {"task": facts.tasks(), "variable": facts.variables(), "rtpu": rtpus}
        for kind, known in names.items():
            if self.name in known:
                return Question(kind=kind, name=self.name)
        every = [name for known in names.values() for name in known]
        what = f"no task, variable or RTPU {self.name}"
        raise _unknown(what, self.name, every, facts)


def asked_by(words: Sequence[str], trace: float = 0.0) -> Question:
    """Return the question that words ask; none asks about the flag.

    Args:
        words: The words.
        trace: Of a miss: seconds for which it is followed who has the core.

    Raises:
        StateError: They are no question.
    """
    asked = _asked_by(words)
    if not trace:
        return asked
    if asked.kind != "miss" or asked.cycle or not 0 < trace <= m.LONGEST_TRACE:
        raise StateError(
            "a core is followed for the next miss of a task",
            expected=f"miss TASK, and up to {m.LONGEST_TRACE:g} s",
            got=f"{' '.join(words)}, {trace:g} s",
            remedy="ask 'miss TASK' with a trace, or leave the trace out",
        )
    return structs.replace(asked, trace=trace)


def _asked_by(words: Sequence[str]) -> Question:
    """Return the question that words ask.

    Raises:
        StateError: They are no question.
    """
    match list(words):
        case [] | ["flag"]:
            return Question(kind="flag")
        case ["start"]:
            return Question(kind="start")
        case ["start", job]:
            return Question(kind="start", name=job)
        case ["miss", task]:
            return Question(kind="miss", name=task)
        case ["miss", task, cycle] if cycle.isdecimal():
            return Question(kind="miss", name=task, cycle=int(cycle))
        case [name] if name != "miss":
            return Question(kind="", name=name)
        case _:
            raise _no_question(words)


def _no_question(words: Sequence[str]) -> StateError:
    return StateError(
        "this is nothing that can be explained",
        expected=_USES,
        got=" ".join(words),
        remedy="'pbonet explain --help' has examples",
    )


def _unknown(what: str, name: str, known: Sequence[str], facts: Facts) -> StateError:
    if facts.silent and not did_you_mean(name, known):
        silent = " and ".join(facts.silent)
        return StateError(
            f"the RTPUs that answer have {what}",
            expected=_USES,
            got=f"{name}, and no answer of {silent}",
            remedy=f"ask about {next(iter(facts.silent))}, which may have it",
        )
    return StateError(
        f"the subsystem has {what}",
        expected=_USES,
        got=name,
        remedy=did_you_mean(name, known) or "'pbonet status' and 'display' show names",
    )
