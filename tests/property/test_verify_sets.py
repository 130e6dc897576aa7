"""Verification against the set equations, and orders against their promise."""

import sys
from itertools import combinations
from pathlib import Path

from hypothesis import given, strategies as st

from pbonet.analysis import legality

sys.path.insert(0, str(Path(__file__).parents[1] / "unit"))

from verify_parts import configuration, task

VARIABLES = ["A", "B", "C", "D", "E"]
subsets = st.lists(st.sampled_from(VARIABLES), unique=True, max_size=3).map(" ".join)


@st.composite
def tasks(draw: st.DrawFn, constants: bool = False) -> list[legality.Task]:
    first, second = ("inconst", "outconst") if constants else ("invar", "outvar")
    return [
        task(
            f"t{number}",
            critical=draw(st.booleans()),
            freq=draw(st.sampled_from([10.0, 100.0])),
            **{first: draw(subsets), second: draw(subsets)},
        )
        for number in range(draw(st.integers(0, 6)))
    ]


@given(tasks(), st.sets(st.integers(0, 5)))
def test_equations_1_and_2(chosen: list[legality.Task], numbers: set[int]) -> None:
    on = {f"t{n}" for n in numbers}
    running = [t for t in chosen if t.name in on]
    disjoint = all(
        not set(a.outputs) & set(b.outputs) for a, b in combinations(running, 2)
    )
    read = {name for t in running for name in t.inputs}
    written = {name for t in running for name in t.outputs}
    codes = {p.code.value for p in legality.check(configuration(*chosen, on=on))}
    assert ("two-writers" not in codes) == disjoint
    assert ("no-writer" not in codes) == (read <= written)
    assert codes <= {"two-writers", "no-writer"}


@given(tasks(constants=True))
def test_spawning_order_or_a_circle(chosen: list[legality.Task]) -> None:
    config = configuration(*chosen, on=set())
    circle = [p for p in legality.check(config) if p.code == "init-cycle"]
    if circle:
        names = circle[0].got.split(" --")
        assert names[0] == circle[0].tasks[0]
        assert circle[0].got.endswith(f"> {names[0]}")
        return
    order = legality.spawn_order(chosen)
    assert sorted(order) == sorted(t.name for t in chosen)
    for giver in chosen:
        for user in chosen:
            if set(giver.gives) & set(user.needs):
                assert order.index(giver.name) < order.index(user.name)
    steps = legality.spawn_steps(chosen)
    assert sorted(name for step in steps for name in step) == sorted(order)
    at = {name: n for n, step in enumerate(steps) for name in step}
    for one, other in combinations(chosen, 2):
        first, last = sorted((one, other), key=lambda task: order.index(task.name))
        linked = one.rtpu == other.rtpu or set(first.gives) & set(last.needs)
        assert not linked or at[first.name] < at[last.name]


@given(tasks())
def test_the_flow_order_breaks_no_more_than_circles(
    chosen: list[legality.Task],
) -> None:
    order = legality.flow_order(chosen)
    assert sorted(order) == sorted(t.name for t in chosen)
    feeds = {
        a.name: {b.name for b in chosen if a != b and set(a.outputs) & set(b.inputs)}
        for a in chosen
    }

    def reaches(start: str, goal: str) -> bool:
        seen, todo = {start}, [start]
        while todo:
            for name in feeds[todo.pop()] - seen:
                seen.add(name)
                todo.append(name)
        return goal in seen

    for producer, consumers in feeds.items():
        for consumer in consumers:
            if not reaches(consumer, producer):
                assert order.index(producer) < order.index(consumer)
    ranks = legality.user_priorities(chosen)
    assert sorted(ranks.values()) == list(range(1, len(chosen) + 1))
    assert sorted(order, key=lambda name: -ranks[name]) == order


@given(tasks())
def test_off_is_the_reverse_of_on(chosen: list[legality.Task]) -> None:
    order = legality.on_order(chosen)
    assert legality.off_order(chosen) == order[::-1]
    critical = [t.name for t in chosen if t.rmod.critical]
    assert set(order[len(order) - len(critical) :]) == set(critical)


@given(tasks(), st.data())
def test_ending_is_never_refused(chosen: list[legality.Task], data) -> None:
    names = [t.name for t in chosen] + ["nobody"]
    items = data.draw(
        st.lists(
            st.tuples(st.sampled_from(names), st.sampled_from(sorted(legality.ENDING)))
        )
    )
    verdict = legality.judge(configuration(*chosen), legality.reconfig(items))
    assert verdict.refused == ()
