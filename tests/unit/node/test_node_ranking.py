"""Which criticality a task gets: the rule of verification fills in what nobody says."""

from types import SimpleNamespace

import pytest
from msgspec import structs

from pbonet.analysis.schedule import CoreShare
from pbonet.config import parse_rmod
from pbonet.config.model import RtpuEntry, Scheduler, TaskType
from pbonet.node.rtpu.ranking import CoreBudget, Ranked, RankRequest, rank

RMOD = """
MODULE counts
DESC none
INCONST none
OUTCONST none
INVAR none
OUTVAR none
TASKTYPE periodic
{lines}
EOF
"""


def wish(name, freq, *, lines=(), **more):
    """Return a task; `freq` in Hz, `lines` go into its RMOD."""
    text = RMOD.format(lines="\n".join([f"FREQ {freq:g}", *lines]))
    return RankRequest(
        name=name, rmod=parse_rmod(text, f"{name}.rmod"), freq=freq, **more
    )


CORE = CoreShare(share=0.95)


def ranked(*wishes, core=CORE, **entry):
    return rank(RtpuEntry(name="arm0", **entry), wishes, core)


def crits(*wishes, **entry):
    return {name: one.crit for name, one in ranked(*wishes, **entry).items()}


def test_muf_assumes_what_it_does_not_know():
    found = ranked(wish("a", 100.0, lines=["MAXC 0.001"]), wish("b", 50.0))
    assert found == {
        "a": Ranked(5, 0, assumed=False, drop=3),
        "b": Ranked(5, 0, assumed=True, drop=3),
    }


@pytest.mark.parametrize(
    ("scheduler", "drops"), [("MUF", (3, 4)), ("EDF", (3, 4)), ("RM", (0, 0))]
)
def test_what_is_left_of_a_task_whose_reserve_is_used_up(scheduler, drops):
    """Sections 6.4.1 and 6.5.2.1; under RM criticalities are rates, and 0 is below."""
    server = wish("s", 100.0)
    kept = structs.replace(server.rmod, tasktype=TaskType.DEFERRABLE, capacity=0.001)
    server.rmod = kept
    found = ranked(wish("a", 100.0), server, scheduler=Scheduler(scheduler))
    assert (found["a"].drop, found["s"].drop) == drops


def test_muf_leaves_out_what_does_not_fit():
    a, b = wish("a", 100.0, lines=["MAXC 0.006"]), wish("b", 50.0, lines=["MAXC 0.01"])
    assert crits(a, b) == {"a": 5, "b": 3}


def test_what_is_off_takes_nothing_from_what_is_on():
    """`a` would fill the core; while it is OFF, `b` and `c` are the critical set."""
    a = wish("a", 100.0, lines=["MAXC 0.009"], on=False)
    b, c = (wish(name, 50.0, lines=["MAXC 0.008"]) for name in "bc")
    assert crits(a, b, c) == {"a": 5, "b": 5, "c": 5}
    a.on = True
    assert crits(a, b, c) == {"a": 5, "b": 3, "c": 3}
    c.on = False
    assert crits(a, b, c)["c"] == 3  # as if all were ON


@pytest.mark.parametrize(("maxc", "crit"), [("0.0094", 5), ("0.0096", 3)])
def test_the_core_is_planned_up_to_its_limit(maxc, crit):
    assert crits(wish("a", 100.0, lines=[f"MAXC {maxc}"])) == {"a": crit}


def test_dispatching_is_taken_off_what_many_tasks_may_use():
    """Ten tasks at 1 kHz and 20 us a release: a fifth of the core is the dispatcher's.

    One of 20 Hz fits beside one of the ten, and not beside all.
    """
    core = CoreShare(share=1.0, dispatch=20e-6)
    last = wish("z", 20.0, lines=["MAXC 0.01"])
    fast = [wish(f"a{n}", 1000.0, lines=["MAXC 0.00006"]) for n in range(10)]
    assert crits(fast[0], last, core=core)["z"] == 5
    assert crits(*fast, last, core=core)["z"] == 3
    assert crits(*fast, last, core=CoreShare())["z"] == 5


def counts(tid, releases):
    return SimpleNamespace(leader_tid=tid, releases=releases)


def test_the_cost_of_a_release_is_measured_and_seldom_changes():
    granted = SimpleNamespace(share=0.95, share_reason="the kernel")
    budget = CoreBudget(granted, None, below=True)
    assert budget.share().dispatch == 1e-5
    assert not budget.update(counts(7, 1000), 5_000_000)
    assert not budget.update(counts(7, 2999), 100_000_000)  # too few releases yet
    assert budget.update(counts(7, 3000), 41_000_000)  # 18 us each
    assert budget.share() == CoreShare(
        share=0.95, dispatch=20e-6, reason="the kernel; 20 us a release, measured"
    )
    assert not budget.update(counts(7, 5000), 61_000_000)  # 14 us: little below
    assert not budget.update(counts(9, 5000), 900_000_000)  # another leader begins
    assert budget.update(counts(9, 7000), 907_000_000)  # 3.5 us
    assert budget.share().dispatch == 5e-6


def test_the_setting_goes_before_the_kernel_and_a_dispatcher_apart_costs_nothing():
    granted = SimpleNamespace(share=0.95, share_reason="the kernel")
    budget = CoreBudget(granted, 0.8, below=False)
    assert not budget.update(counts(1, 0), 0)
    assert not budget.update(counts(1, 9999), 1_000_000_000)
    assert budget.share() == CoreShare(share=0.8, reason="core_share of agent.toml")
    budget = CoreBudget(granted, None, below=False)
    assert (budget.share().share, budget.share().dispatch) == (1.0, 0.0)


def test_rm_goes_by_rate():
    found = crits(wish("a", 1.0), wish("b", 1000.0), scheduler=Scheduler.RM)
    assert found == {"a": 1, "b": 62}


def test_rm_tells_rates_apart_within_its_range_alone():
    found = crits(
        *(
            wish(name, freq)
            for name, freq in zip("abcd", (5, 10, 100, 500), strict=True)
        ),
        scheduler=Scheduler.RM,
        minfreq=10.0,
        maxfreq=100.0,
    )
    assert found == {"a": 1, "b": 1, "c": 62, "d": 62}


def test_edf_gives_all_the_same():
    found = crits(wish("a", 1.0), wish("b", 500.0), scheduler=Scheduler.EDF)
    assert found["a"] == found["b"]


def test_who_is_asked_first():
    """The master's last word, then the spawn, then the RMOD, then the rule."""
    one = wish("a", 10.0, lines=["MAXC 0.001", "CRIT 20"], priority=7)
    assert ranked(one)["a"] == Ranked(20, 7, assumed=False, drop=3)
    one.spawn_crit = 30
    assert ranked(one)["a"].crit == 30
    one.told = (40, 8)
    assert ranked(one)["a"] == Ranked(40, 8, assumed=False, drop=3)
    one.told = (None, 9)
    assert ranked(one)["a"] == Ranked(20, 9, assumed=False, drop=3)


def test_nobody():
    assert ranked() == {}
