"""Aperiodic servers as real tasks: what they may use, and what they leave to others."""

import os
import statistics

import pytest
from nodekit import CORE, level, others_go_first, rmod
from plain_dispatcher.dispatch import replay
from reference import Reference
from watching import wait_for

from pbonet.analysis.schedule.criticality import RM_LEVELS
from pbonet.analysis.schedule.events import Event, turns
from pbonet.errors import DeclarationError
from pbonet.node.rt import _rt

KINDS = ("deferrable", "sporadic")


@pytest.fixture
def pipe(tmp_path):
    path = tmp_path / "events"
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR)
    yield path, lambda *events: os.write(fd, bytes(events))
    os.close(fd)


@pytest.fixture
def critical(arm):
    """A task of the critical set, which misses nothing whatever the server does."""
    text = rmod("counts", out="Y7", freq=50.0).replace("FREQ 50", "FREQ 50\nMAXC 0.002")
    arm.spawn("good", "counts", text=text)
    arm.on("good")
    tid = arm.wait_cycles("good", 5).tid
    with Reference(CORE, level(tid)) as reference:
        before = arm.status("good")
        yield
        after = arm.wait_cycles("good", 5)
        assert after.miss - before.miss <= reference.lost(50.0)


def serve(arm, pipe, kind, *, capacity=0.004, freq=20.0, **local):
    """Turn a server on that gets its events from the pipe."""
    text = rmod("serves", freq=freq, local={"FIFO": pipe[0], **local})
    text = text.replace("periodic", kind)
    if kind == "background":
        text = text.replace(f"FREQ {freq:g}\n", "")
    else:
        text = text.replace(f"FREQ {freq:g}", f"FREQ {freq:g}\nCAPACITY {capacity:g}")
    arm.spawn("s", "serves", text=text)
    arm.on("s")


def wait_served(arm, count, total):
    wait_for(lambda: arm.value("Y0").values == [count, total], f"{count} events")


def history(nodes, task):
    """Return what was told and decided of a task, turn by turn: instant, both."""
    table = _rt.CoreTable(nodes.state("arm0").core, member=False)
    try:
        slot = next(
            i for i in table.slots() if table.snapshot(i).task.endswith(f"/{task}")
        )
        _, lost, trace = table.trace()
    finally:
        table.close()
    assert not lost
    replay(trace)
    return [
        (head.a, *([r for r in part if r.slot == slot] for part in (told, found)))
        for head, told, found in turns(trace)
    ]


def decisions(nodes, task):
    """Return the decisions about a task: event, argument, and the turn's instant."""
    return [
        (Event(record.kind), record.arg, record.a, at)
        for at, _, found in history(nodes, task)
        for record in found
    ]


@pytest.mark.usefixtures("critical")
@pytest.mark.parametrize("kind", KINDS)
class TestCapacity:
    """What a server uses beyond its capacity it takes from nobody."""

    def test_small_events_are_served_at_its_own_criticality(self, arm, pipe, kind):
        serve(arm, pipe, kind)
        pipe[1](1)
        wait_served(arm, 1, 1)
        status = arm.status("s")
        assert (status.S, status.crit, status.rank) == (kind[0].upper(), 6, 6)
        assert status.reserve == pytest.approx(0.004)
        assert status.overruns == 0
        assert status.failures == {"deadline": 0, "maxexec": 0, "minexec": 0}

    def test_a_large_event_is_ended_at_a_lower_criticality(
        self, arm, nodes, pipe, kind
    ):
        serve(arm, pipe, kind)
        pipe[1](15)
        wait_served(arm, 1, 15)
        wait_for(lambda: arm.status("s").rank == 6, "its capacity back")
        found = decisions(nodes, "s")
        drops = [at for event, arg, _, at in found if (event, arg) == (Event.CRIT, 4)]
        rises = [at for event, arg, _, at in found if (event, arg) == (Event.CRIT, 6)]
        assert drops
        assert rises[-1] > drops[-1]
        assert arm.status("s").overruns == len(drops)

    def test_a_flood_gets_the_capacity_and_what_is_left_over(
        self, arm, nodes, pipe, kind
    ):
        serve(arm, pipe, kind)
        pipe[1](*[3] * 30)
        wait_served(arm, 30, 90)
        back = [a for event, _, a, _ in decisions(nodes, "s") if event is Event.REFILL]
        assert back
        # What it uses until a dispatcher that comes late stops it, it lacks later.
        assert min(back) > 0
        assert statistics.median(back) <= 4_000_000 + 200_000


def test_a_sporadic_server_gets_back_what_it_used_a_period_later(arm, nodes, pipe):
    """What it used to wait for its first event may come back before the rest."""
    serve(arm, pipe, "sporadic", freq=10.0)
    pipe[1](2)
    wait_served(arm, 1, 2)

    def back(since):
        found = decisions(nodes, "s")
        return sum(
            a for event, _, a, at in found if event is Event.REFILL and at >= since
        )

    begun = next(
        record.a
        for _, told, _ in history(nodes, "s")
        for record in told
        if (record.kind, record.arg) == (Event.EVENT, 1)
    )
    wait_for(lambda: back(begun + 100_000_000) >= 2_000_000, "its capacity back")
    assert back(0) <= 4_000_000


@pytest.mark.usefixtures("critical")
@pytest.mark.parametrize("kind", KINDS)
def test_a_critical_section_keeps_the_criticality_up_to_its_bound(
    arm, nodes, pipe, kind
):
    """Section 6.3: whoever holds something that others need is not lowered amid it."""
    serve(arm, pipe, kind, LOCKED=True)
    pipe[1](15)
    wait_served(arm, 1, 15)
    status = wait_for(
        lambda: (one := arm.status("s")).rank == 6 and one, "its capacity back"
    )
    assert status.overruns >= 1
    assert status.held_off >= 1
    begun, exhausted, dropped = None, None, None
    for at, told, found in history(nodes, "s"):
        used = [r for r in told if r.kind == Event.USED]
        if any(r.kind == Event.EVENT and r.arg == 1 for r in told):
            begun = used[0].a
        elif begun is not None and used and used[0].a - begun >= 3_500_000:
            exhausted = exhausted or at
            assert dropped or used[0].arg == 1, "it is in its section"
        if any((r.kind, r.arg) == (Event.CRIT, 4) for r in found):
            dropped = dropped or at
    assert dropped >= exhausted + 1_000_000


def test_background_work_runs_below_everything(arm, pipe):
    serve(arm, pipe, "background")
    pipe[1](5, 5)
    wait_served(arm, 2, 10)
    assert (arm.status("s").S, arm.status("s").crit) == ("B", 1)


@pytest.mark.parametrize("kind", KINDS)
def test_under_rm_a_server_is_above_all_rates_and_then_below_them(nodes, kind, pipe):
    nodes.agent("arm0")
    master = nodes.master("arm0", "arm", scheduler="RM")
    serve(master, pipe, kind)
    pipe[1](15)
    wait_served(master, 1, 15)
    found = decisions(nodes, "s")
    assert 0 in {arg for event, arg, *_ in found if event is Event.CRIT}
    assert master.status("s").crit == RM_LEVELS


@pytest.mark.parametrize("kind", KINDS)
def test_under_park_a_server_falls_and_rises_by_the_same_decisions(nodes, kind, pipe):
    nodes.agent("arm0", backend="park")
    master = nodes.master("arm0", "arm")
    serve(master, pipe, kind)
    pipe[1](15)
    wait_served(master, 1, 15)
    wait_for(lambda: master.status("s").rank == 6, "its capacity back")
    changes = [arg for event, arg, *_ in decisions(nodes, "s") if event is Event.CRIT]
    assert changes[:2] == [4, 6]
    assert master.status("s").overruns == changes.count(4)


@pytest.mark.parametrize("kind", [*KINDS, "background"])
def test_a_server_that_does_not_say_how_it_waits_is_refused(arm, kind):
    text = rmod("counts").replace("periodic", kind)
    more = "" if kind == "background" else "FREQ 200\nCAPACITY 0.001"
    text = text.replace("FREQ 200", more)
    error = arm.refused(DeclarationError, arm.spawn, "a", "counts", text=text)
    assert error.what == (
        f"module counts has no sync(), which TASKTYPE {kind} counts on"
    )


@pytest.mark.parametrize("kind", [*KINDS, "background"])
def test_commands_reach_a_server_that_waits(arm, pipe, kind):
    serve(arm, pipe, kind)
    assert arm.off("s").state == "OFF"
    assert arm.on("s").state == "ON"
    pipe[1](1)
    wait_served(arm, 1, 1)
    assert arm.kill("s").state == "NOT-CREATED"


@pytest.mark.parametrize(
    ("scheduler", "kind", "crit"),
    [("MUF", "deferrable", 2), ("EDF", "sporadic", None), ("RM", "deferrable", None)],
)
def test_events_without_end_get_no_more_than_a_server_s_capacity(
    nodes, scheduler, kind, crit
):
    """Less critical tasks and commands to them go before what is beyond it."""
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", scheduler=scheduler)
    arm.spawn("good", "counts", out="Y7", freq=10.0, crit=crit)
    text = rmod("never_waits", freq=20.0).replace("periodic", kind)
    text = text.replace("FREQ 20\n", "FREQ 20\nCAPACITY 0.004\n")
    arm.spawn("bad", "never_waits", text=text)
    arm.on("good")
    arm.on("bad")
    assert "capacity is used up in every period" in arm.wait_event("HANGS", "bad").text
    others_go_first(arm)
    assert len(arm.events("HANGS", "bad")) == 1
