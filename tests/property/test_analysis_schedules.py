"""What the analysis promises against schedules; the simulator against two others."""

from __future__ import annotations

from itertools import pairwise, takewhile
from math import lcm

from hypothesis import assume, given, settings, strategies as st
from plain_dispatcher.dispatch import LEAD_NS
from plain_dispatcher.inline import Inline
from verify_parts import rtpu, task as legality_task

from pbonet.analysis.legality.demands import going_first
from pbonet.analysis.legality.timing import criticalities
from pbonet.analysis.schedule.analysis import (
    Demand,
    critical_set,
    edf_schedulable,
    level_guaranteed,
    response_time,
    rm_bound_holds,
    rm_schedulable,
    set_aside,
    transform,
    utilization,
)
from pbonet.analysis.schedule.core_share import CoreShare
from pbonet.analysis.schedule.effective_time import every
from pbonet.analysis.schedule.servers import Server, ServerKind, safe_size, server_size
from pbonet.analysis.schedule.simulate import PeriodicTask, ServerTask, simulate

PERIODS = [4, 5, 6, 8, 10, 12, 15, 20, 24, 30]
"""Whose least common multiple is 120."""


@st.composite
def demands(draw, most: int = 5) -> list[Demand]:
    found = []
    for number in range(draw(st.integers(1, most))):
        period = draw(st.sampled_from(PERIODS))
        cost = draw(st.integers(1, max(1, period // 2)))
        found.append(Demand(name=f"t{number}", period_ns=period, cost_ns=cost))
    return found


def hyperperiod(tasks: list[Demand]) -> int:
    return lcm(*(task.period_ns for task in tasks))


def task_of(task: Demand, **more) -> PeriodicTask:
    return PeriodicTask(
        name=task.name,
        period_ns=task.period_ns,
        cost=task.cost_ns,
        deadline_ns=task.deadline_ns,
        **more,
    )


def by_ticks(tasks: list[PeriodicTask], until: int):
    """Do it all again, tick by tick: misses, late cycles, response times."""
    left = dict.fromkeys(range(len(tasks)), 0)
    begun = dict.fromkeys(left, False)
    rel, dl, own = (
        dict.fromkeys(left, 0),
        dict.fromkeys(left, 0),
        dict.fromkeys(left, 0),
    )
    ready: set[int] = set()
    found = [{"missed": 0, "late": 0, "responses": []} for _ in tasks]
    for now in range(until + 1):
        for k, task in enumerate(tasks):
            if now % task.period_ns == 0:
                found[k]["missed"] += k in ready
                if not begun[k]:
                    rel[k], left[k] = now, task.cost
                dl[k] = now + (task.deadline_ns or task.period_ns)
                ready.add(k)
        if not ready or now == until:
            continue
        k = min(
            ready, key=lambda k: (-tasks[k].crit, dl[k], -tasks[k].priority, rel[k], k)
        )
        if not begun[k]:
            begun[k], own[k] = True, dl[k]
        left[k] -= 1
        if not left[k]:
            ready.remove(k)
            begun[k] = False
            found[k]["responses"].append(now + 1 - rel[k])
            found[k]["late"] += now + 1 > own[k]
    return found


@settings(max_examples=150, deadline=None)
@given(demands(), st.data())
def test_the_simulator_against_one_that_goes_tick_by_tick(sets, data) -> None:
    tasks = [
        task_of(
            one,
            crit=data.draw(st.integers(3, 6)),
            priority=data.draw(st.integers(0, 2)),
        )
        for one in sets
    ]
    until = 2 * hyperperiod(sets)
    accounts = list(simulate(tasks, until_ns=until).tasks.values())
    assert [
        {"missed": a.missed, "late": a.late, "responses": a.responses_ns}
        for a in accounts
    ] == by_ticks(tasks, until)


@settings(max_examples=60, deadline=None)
@given(demands(6), st.data())
def test_the_simulator_against_the_twin_of_the_dispatcher(sets, data) -> None:
    """Slice by slice; times with odd nanoseconds, so that events do not coincide."""
    unit = 1_000_000
    start = 120 * unit
    tasks = [
        PeriodicTask(
            name=one.name,
            period_ns=one.period_ns * unit,
            cost=one.cost_ns * unit + data.draw(st.integers(1, 99_999)) * 2 + 1,
            crit=data.draw(st.integers(3, 6)),
            priority=data.draw(st.integers(0, 2)),
        )
        for one in sets
    ]
    twin = Inline(start - LEAD_NS)
    for task in tasks:
        twin.add(
            task.name,
            lambda _now, _dt, cost=task.cost: cost,
            period_ns=task.period_ns,
            crit=task.crit,
            priority=task.priority,
        )
        twin.on(task.name)
    twin.run_until(start + 240 * unit)
    outcome = simulate(tasks, start_ns=start, until_ns=start + 240 * unit)
    assert [(s.task, s.start_ns, s.end_ns) for s in outcome.segments] == [
        (s.task, s.start_ns, s.end_ns) for s in twin.slices
    ]
    for name, account in outcome.tasks.items():
        other = twin.tasks[name]
        assert account.missed == twin.missed(name)
        assert (account.cycles, account.late) == (other.cycles, other.late)
        assert account.responses_ns == other.responses


@settings(deadline=None)
@given(demands(), st.data())
def test_what_edf_can_schedule_misses_nothing(sets, data) -> None:
    tasks = [task_of(one, offset_ns=data.draw(st.integers(0, 29))) for one in sets]
    span = 3 * hyperperiod(sets)
    if edf_schedulable(sets):
        assert simulate(tasks, until_ns=span).missing == set()
    else:
        assert utilization(sets) > 1
        assert simulate([task_of(one) for one in sets], until_ns=span).missing


@settings(deadline=None)
@given(demands(), st.data())
def test_edf_with_early_deadlines_is_judged_exactly(sets, data) -> None:
    early = [
        Demand(
            name=one.name,
            period_ns=one.period_ns,
            cost_ns=one.cost_ns,
            deadline_ns=data.draw(st.integers(one.cost_ns, one.period_ns)),
        )
        for one in sets
    ]
    outcome = simulate([task_of(one) for one in early], until_ns=2 * hyperperiod(sets))
    assert edf_schedulable(early) == (outcome.missing == set())


@settings(deadline=None)
@given(demands(), st.data())
def test_response_times_under_rm_are_exact(sets, data) -> None:
    order = sorted(sets, key=lambda one: (one.period_ns, one.name))
    levels = {one.name: 60 - place for place, one in enumerate(order)}
    tasks = [task_of(one, crit=levels[one.name]) for one in sets]
    together = simulate(tasks, until_ns=2 * hyperperiod(sets))
    shifted = simulate(
        [task_of(one, crit=levels[one.name], offset_ns=data.draw(st.integers(0, 29)))
         for one in sets],
        until_ns=2 * hyperperiod(sets) + 30,
    )  # fmt: skip
    for place, one in enumerate(order):
        worst = response_time(one, order[:place])
        account = together.tasks[one.name]
        assert account.misses == (worst is None)
        if worst is None:
            break
        assert max(account.responses_ns) == worst
        assert max(shifted.tasks[one.name].responses_ns, default=0) <= worst
        assert not shifted.tasks[one.name].misses
    if rm_bound_holds(sets):
        assert rm_schedulable(sets)


@settings(deadline=None)
@given(demands(), st.data())
def test_guaranteed_under_fixed_criticalities(sets, data) -> None:
    levels = {one.name: data.draw(st.integers(3, 5)) for one in sets}
    kept = level_guaranteed(sets, levels)
    tasks = [
        task_of(
            one,
            crit=levels[one.name],
            offset_ns=data.draw(st.integers(0, 29)),
            priority=data.draw(st.integers(0, 1)),
        )
        for one in sets
    ]
    assert not kept & simulate(tasks, until_ns=3 * hyperperiod(sets)).missing


kinds = st.sampled_from([
    ServerKind.DEFERRABLE,
    ServerKind.SPORADIC,
    ServerKind.POLLING,
])


@st.composite
def events(draw) -> list[tuple[int, int]]:
    gaps = draw(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 9)), max_size=40))
    now, found = 0, []
    for gap, cost in gaps:
        now += gap
        found.append((now, cost))
    return found


@st.composite
def served(draw) -> tuple[Server, ServerTask]:
    kind = draw(kinds)
    period = draw(st.sampled_from(PERIODS))
    capacity = draw(st.integers(1, max(1, period // 2)))
    server = Server(kind=kind, capacity_ns=capacity, period_ns=period)
    drop = draw(st.sampled_from([4, None]))
    task = ServerTask(
        name="server",
        kind=kind,
        arrivals=draw(events()),
        capacity_ns=capacity,
        period_ns=period,
        offset_ns=draw(st.integers(0, 29)),
        drop_crit=drop,
    )
    return server, task


@settings(max_examples=300, deadline=None)
@given(demands(), served(), st.data())
def test_the_critical_set_never_misses(sets, pair, data) -> None:
    """Beside a server, soft tasks that overrun, and others that overload the core."""
    server, task = pair
    inside = critical_set(sets, [server])
    tasks = []
    for one in sets:
        soft = data.draw(st.booleans())
        tasks.append(
            PeriodicTask(
                name=one.name,
                period_ns=one.period_ns,
                cost=one.cost_ns + (data.draw(st.integers(0, 9)) if soft else 0),
                crit=5 if one.name in inside else 3,
                effective_ns=one.cost_ns if soft else 0,
                least_ns=data.draw(st.integers(0, one.cost_ns)),
                offset_ns=data.draw(st.integers(0, 29)),
            )
        )
    outcome = simulate(tasks, [task], until_ns=600)
    hard = {t.name for t in tasks if not t.effective_ns or t.cost <= t.effective_ns}
    assert not outcome.missing & set(inside) & hard


@settings(max_examples=200, deadline=None)
@given(served(), st.data())
def test_a_server_never_uses_more_than_its_analysis_says(pair, data) -> None:
    server, task = pair
    other = PeriodicTask(name="a", period_ns=20, cost=data.draw(st.integers(1, 19)))
    outcome = simulate([other], [task], until_ns=400)
    slices = [s for s in outcome.segments if s.task == "server" and s.crit == task.crit]
    for first in range(len(slices)):
        used = 0
        for last in range(first, min(len(slices), first + 20)):
            used += slices[last].end_ns - slices[last].start_ns
            window = slices[last].end_ns - slices[first].start_ns
            assert used <= server.taken_ns(window)


@settings(deadline=None)
@given(demands(), served())
def test_rate_monotonic_tasks_below_a_server(sets, pair) -> None:
    server, task = pair
    assume(rm_schedulable(sets, [server]))
    order = sorted(sets, key=lambda one: (one.period_ns, one.name))
    tasks = [task_of(one, crit=50 - place) for place, one in enumerate(order)]
    top = ServerTask(
        name="server",
        kind=task.kind,
        arrivals=task.arrivals,
        capacity_ns=task.capacity_ns,
        period_ns=task.period_ns,
        offset_ns=task.offset_ns,
        crit=62,
        drop_crit=None,
    )
    assert simulate(tasks, [top], until_ns=600).missing == set()


def in_milliseconds(sets: list[Demand]) -> list[Demand]:
    """Return tasks with periods and costs of as many milliseconds."""
    return [
        Demand(name=t.name, period_ns=t.period_ns * 10**6, cost_ns=t.cost_ns * 10**6)
        for t in sets
    ]


@settings(deadline=None)
@given(
    st.sampled_from([ServerKind.DEFERRABLE, ServerKind.SPORADIC]),
    demands(),
)
def test_a_server_of_the_safe_size_leaves_room(kind, sets) -> None:
    """The periods are no shorter than the server's, as section 6.5.2.1 has it."""
    assume(utilization(sets) <= 1)
    scaled = in_milliseconds(sets)
    period = min(one.period_ns for one in scaled)
    size = safe_size(kind, utilization(sets))
    assert size <= server_size(kind, utilization(sets), tasks=1)
    server = Server(kind=kind, capacity_ns=int(size * period * 0.999), period_ns=period)
    assert edf_schedulable(scaled, [server])


@settings(deadline=None)
@given(demands(), st.sets(st.sampled_from(["t0", "t1", "t2", "t3", "t4"])))
def test_a_proposed_transformation_does_what_it_is_for(sets, critical) -> None:
    scaled = in_milliseconds(sets)
    must = {one.name for one in scaled} & critical
    changes = transform(scaled, critical)
    if changes is None:
        assert utilization([t for t in scaled if t.name in must]) > 1 - 1e-4
        return
    new = {change.name: change for change in changes}
    assert set(new) <= must
    changed = [
        Demand(
            name=t.name,
            period_ns=new[t.name].period_ns if t.name in new else t.period_ns,
            cost_ns=new[t.name].cost_ns if t.name in new else t.cost_ns,
        )
        for t in scaled
    ]
    assert must <= set(critical_set(changed))
    assert (not changes) == (must <= set(critical_set(scaled)))
    for change in changes:
        old = next(t for t in scaled if t.name == change.name)
        assert change.factor == old.period_ns // change.period_ns
        assert change.cost_ns * change.factor >= old.cost_ns


@settings(deadline=None)
@given(demands(), st.sets(st.sampled_from(["t0", "t1", "t2", "t3", "t4"])))
def test_a_criticality_does_what_a_transformation_does(sets, critical) -> None:
    """No module need be divided for MUF: as many others are guaranteed as well."""
    scaled = in_milliseconds(sets)
    names = {one.name for one in scaled}
    aside = set_aside(scaled, critical)
    changes = transform(scaled, critical)
    if aside is None:
        assert changes is None
        return
    levels = {name: 3 if name in aside else 5 for name in names}
    assert names - {*aside} <= {*level_guaranteed(scaled, levels, ())}
    assert not critical & {*aside}
    if changes is not None:
        new = {change.name: change for change in changes}
        changed = [
            Demand(
                name=t.name,
                period_ns=new[t.name].period_ns if t.name in new else t.period_ns,
                cost_ns=new[t.name].cost_ns if t.name in new else t.cost_ns,
            )
            for t in scaled
        ]
        assert {*critical_set(changed)} <= names - {*aside}


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(PERIODS),
    st.data(),
    st.lists(st.integers(1, 30), min_size=1, max_size=40),
)
def test_both_guarantees_of_a_soft_task(period, data, costs) -> None:
    """Section 6.4: in time in a cycle of at most E; one of every n cycles executed."""
    effective = data.draw(st.integers(1, period))
    others = data.draw(demands(3))
    asked = [Demand(name="soft", period_ns=period, cost_ns=effective), *others]
    assume(edf_schedulable(asked))
    drawn: list[int] = []

    def cost() -> int:
        drawn.append(costs[len(drawn) % len(costs)])
        return drawn[-1]

    soft = PeriodicTask(
        name="soft", period_ns=period, cost=cost, effective_ns=effective
    )
    outcome = simulate([soft, *map(task_of, others)], until_ns=1200)
    assert outcome.missing <= {"soft"}
    account = outcome.tasks["soft"]
    for needed, response in zip(drawn, account.responses_ns, strict=False):
        if needed <= effective:
            assert response <= period
    n = every(max(costs), effective)
    run = longest = 0
    for before, after in pairwise([-period, *account.misses_ns]):
        run = run + 1 if after - before == period else 1
        longest = max(longest, run)
    assert longest <= n - 1


@settings(max_examples=1000, deadline=None)
@given(demands(6))
def test_muf_keeps_every_critical_deadline_that_rm_keeps(sets) -> None:
    """Section 6.2.3: MUF performs at least as well as RM in all cases.

    All are released together, which is RM's worst case. Its critical set is then the
    tasks of the highest rates down to the first that misses: a slower one is in time
    only when that one has given up cycles.
    """
    order = sorted(sets, key=lambda one: (one.period_ns, one.name))
    inside = set(critical_set(sets))
    rm = [task_of(one, crit=60 - place) for place, one in enumerate(order)]
    muf = [task_of(one, crit=5 if one.name in inside else 3) for one in order]
    until = 2 * hyperperiod(sets)
    kept, missed = (
        {one.name: found["missed"] for one, found in zip(order, ticks, strict=True)}
        for ticks in (by_ticks(rm, until), by_ticks(muf, until))
    )
    safe = set(takewhile(lambda name: not kept[name], kept))
    assert safe <= inside
    assert not any(missed[name] for name in inside)


@settings(max_examples=300, deadline=None)
@given(demands(6), st.integers(1, 2))
def test_the_critical_set_beside_a_dispatcher_that_takes_its_time(sets, cost) -> None:
    """Each release, of whatever task, takes `cost` before all cycles."""
    tasks = [
        legality_task(one.name, freq=1e9 / one.period_ns, maxc=one.cost_ns / 1e9)
        for one in sets
    ]
    core = CoreShare(dispatch=cost / 1e9)
    levels = criticalities(tasks, rtpu(), core=core)
    ranked = [task_of(one, crit=levels[one.name].crit) for one in sets]
    turns = [
        PeriodicTask(
            name=f"dispatch {one.name}", period_ns=one.period_ns, cost=cost, crit=63
        )
        for one in sets
    ]
    found = by_ticks([*ranked, *turns], 2 * hyperperiod(sets))
    inside = {one.name for one in ranked if one.crit == 5}
    for one, account in zip(ranked, found, strict=False):
        assert not (account["missed"] and one.name in inside)
    if len(inside) < len(sets):
        used = sum((one.cost_ns + cost) / one.period_ns for one in sets)
        assert used > 1 or not edf_schedulable(sets, going_first(tasks, core))
