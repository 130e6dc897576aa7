"""Assignments of few tasks are the cheapest of all that there are."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import event, given, settings, strategies as st
from verify_parts import rtpu, task

from pbonet.analysis.allocation import Flow, Item, Problem, allowed, assign
from pbonet.analysis.allocation.assignment_problem import FOLLOWS
from pbonet.analysis.allocation.linear_program import MOVE
from pbonet.config import TaskType
from pbonet.errors import VerificationError

pytest.importorskip("scipy")
RATES = (50.0, 100.0, 200.0, 300.0)


@st.composite
def items(draw: st.DrawFn, names: list[str]) -> list[Item]:
    """Up to five tasks that read each other's variables; perhaps one stands by."""
    count = draw(st.integers(1, 5))
    found: list[Item] = []
    for at in range(count):
        hz = draw(st.sampled_from(RATES))
        share = draw(st.sampled_from([0.1, 0.3, 0.45, 0.6]))
        reads = draw(st.lists(st.integers(0, count - 1), max_size=2, unique=True))
        server = draw(st.integers(0, 6)) == 0
        kind = {"maxc": share / hz, "crit": draw(st.sampled_from([None, None, 4]))}
        if server:
            kind = {"capacity": share / hz / 2, "tasktype": TaskType.DEFERRABLE}
        one = task(
            f"t{at}",
            freq=hz,
            invar=" ".join(f"V{n}" for n in reads if n != at),
            outvar=f"V{at}",
            **kind,
        )
        present = draw(st.sampled_from(names))
        homes = draw(st.sampled_from([names, names, names, [present]]))
        found.append(
            Item(
                name=one.name,
                present=present,
                tasks=dict.fromkeys(homes, one),
                pin="" if len(homes) > 1 else "FIXED",
            )
        )
    return found


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    names = [f"r{n}" for n in range(draw(st.integers(1, 3)))]
    given = draw(items(names))
    if draw(st.booleans()):
        original = given[0]
        standby = task("standby", freq=100.0, maxc=0.003, outvar="V0")
        kind = draw(st.sampled_from(["follows", "apart", "free"]))
        homes = original.tasks if kind == "follows" else names
        given.append(
            Item(
                name="standby",
                present=original.present,
                tasks=dict.fromkeys(homes, standby),
                pin=FOLLOWS + original.name if kind == "follows" else "",
                fallback_of=original.name,
                apart=kind == "apart",
            )
        )
    return Problem(
        items=tuple(given),
        rtpus=tuple(
            rtpu(name, draw(st.sampled_from(["MUF", "EDF", "RM"]))) for name in names
        ),
        machines={name: draw(st.sampled_from(["left", "right"])) for name in names},
        keeper=names[-1],
        sizes={f"V{n}": 8 * (n + 1) for n in range(5)},
        weight=draw(st.sampled_from([0.0, 0.3, 1.0])),
    )


def total(problem: Problem, flow: Flow, places: dict[str, str]) -> float:
    moved = sum(places[one.name] != one.present for one in problem.items)
    return flow.cost(places).total + MOVE * moved / len(problem.items)


@settings(max_examples=60, deadline=None)
@given(problems())
def test_nothing_is_cheaper(problem: Problem) -> None:
    flow = Flow(problem)
    names = [one.name for one in problem.items]
    every = [entry.name for entry in problem.rtpus]
    legal = [
        places
        for chosen in product(every, repeat=len(names))
        if allowed(problem, places := dict(zip(names, chosen, strict=True)))
    ]
    if not legal:
        event("impossible")
        with pytest.raises(VerificationError):
            assign(problem)
        return
    found = assign(problem)
    assert allowed(problem, found.places)
    assert found.gap == 0.0
    best = min(total(problem, flow, one) for one in legal)
    assert total(problem, flow, found.places) == pytest.approx(best, abs=2e-6)
