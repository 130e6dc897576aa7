"""Criticalities, utilization, and traffic of the table (equations 6 to 9)."""

import pytest
from msgspec import structs
from verify_parts import configuration, figure_6_1, rtpu, task, texts

from pbonet.analysis import legality
from pbonet.analysis.legality import times
from pbonet.analysis.schedule import CoreShare
from pbonet.analysis.schedule.effective_time import from_steps
from pbonet.config.model import TaskType, Variable
from pbonet.node.rt import _rt


def crits(config: legality.Configuration) -> dict[str, int]:
    (entry,) = config.rtpus
    found = legality.criticalities(
        config.tasks, entry, core=config.share_of(entry.name)
    )
    return {name: assigned.crit for name, assigned in found.items()}


def test_muf_splits_at_the_critical_set() -> None:
    config = figure_6_1("MUF")
    assert crits(config) == {"t1": 5, "t2": 5, "t3": 5, "t4": 3}
    (load,) = legality.loads(config)
    assert load.critical_set == ("t1", "t2", "t3")
    assert load.outside == ("t4",)
    assert load.utilization == pytest.approx(2 / 6 + 4 / 10 + 3 / 12 + 4 / 15)
    (problem,) = legality.check(config)
    assert problem.severity == "warn"
    assert legality.as_text(problem) == (
        "arm0: on RTPU arm0 t4 may miss deadlines (expected a utilization of at most "
        "100.0% under MUF, got 125.0%); lower a frequency, or move a task to another "
        "RTPU"
    )


def test_a_critical_task_must_be_in_the_critical_set() -> None:
    config = figure_6_1("MUF", critical=True)
    assert texts(config) == [
        "arm0: RTPU arm0 is too busy for the CRITICAL t4 (expected CRITICAL tasks "
        "within the critical set, the shortest periods whose utilization is at most "
        "100.0%, got 125.0%); give t4 CRIT 5, and t3 CRIT 3, or run t4 at 2 times its "
        "frequency, with at most 0.002 s a cycle (period transformation), lower "
        "another task's frequency, or move one to another RTPU"
    ]


def test_the_crit_lines_of_the_remedy_guarantee_the_critical_task() -> None:
    config = figure_6_1("MUF", critical=True)
    new = {"t4": 5, "t3": 3}
    tasks = tuple(
        structs.replace(one, rmod=structs.replace(one.rmod, crit=new.get(one.name)))
        for one in config.tasks
    )
    (problem,) = legality.check(structs.replace(config, tasks=tasks))
    assert (problem.severity, problem.tasks) == ("warn", ("t3",))


def test_the_crit_lines_name_all_that_a_given_criticality_puts_elsewhere() -> None:
    """CRITICAL t0 is below, t3 above; with t1 they are too much."""
    tasks = [
        task("t0", freq=200.0, maxc=0.002, crit=3, critical=True),
        task("t1", freq=250.0, maxc=0.002),
        task("t2", freq=100.0, maxc=0.004, crit=4, critical=True),
        task("t3", freq=400.0, maxc=0.00025, crit=6),
    ]
    config = configuration(*tasks, rtpus=[rtpu(maxfreq=1000.0)])
    (text,) = texts(config)
    assert "give t0 and t2 and t3 CRIT 5, and t1 CRIT 3, or run" in text
    new = {"t0": 5, "t2": 5, "t3": 5, "t1": 3}
    tasks = tuple(
        structs.replace(one, rmod=structs.replace(one.rmod, crit=new[one.name]))
        for one in config.tasks
    )
    (problem,) = legality.check(structs.replace(config, tasks=tasks))
    assert (problem.severity, problem.tasks) == ("warn", ("t1",))


def test_a_soft_task_may_miss() -> None:
    assert texts(figure_6_1("MUF", softness=0.3)) == []


@pytest.mark.parametrize("scheduler", ["EDF", "RM"])
def test_an_overload_of_soft_tasks_is_started_like_one_of_others(scheduler) -> None:
    soft = [
        structs.replace(one, rmod=structs.replace(one.rmod, softness=0.3))
        for one in (task(name, freq=100, maxc=0.008) for name in "ab")
    ]
    config = configuration(*soft, rtpus=[rtpu(scheduler=scheduler)])
    (problem,) = legality.check(config)
    assert (problem.severity, problem.tasks) == ("warn", ("a", "b"))


def test_edf_has_one_criticality_and_any_task_may_miss_in_an_overload() -> None:
    """It may be started once all times are known, unless ``STRICT`` refuses it."""
    config = figure_6_1("EDF")
    assert len(set(crits(config).values())) == 1
    (load,) = legality.loads(config)
    assert load.critical_set == ()
    assert texts(config) == [
        "arm0: on RTPU arm0 any of t1 and t2 and t3 and t4 may miss deadlines "
        "(expected a utilization of at most 100.0% under EDF, got 125.0%); lower a "
        "frequency, or move a task to another RTPU"
    ]
    assert [problem.severity for problem in legality.check(config)] == ["warn"]
    (problem,) = legality.check(structs.replace(config, strict=True))
    assert problem.severity == "refuse"
    assert "take STRICT out of the .sbs file" in problem.remedy
    (problem,) = legality.check(figure_6_1("EDF", critical=True))
    assert problem.severity == "refuse"
    assert problem.what == "RTPU arm0 is too busy for the CRITICAL t4"
    fewer = configuration(*config.tasks[:3], rtpus=config.rtpus)
    assert texts(fewer) == []
    assert legality.loads(fewer)[0].critical_set == ("t1", "t2", "t3")


def test_rm_goes_by_the_bound_of_equation_9() -> None:
    config = figure_6_1("RM")
    assert texts(config) == [
        "arm0: on RTPU arm0 t3 and t4 may miss deadlines (expected a utilization of at "
        "most 75.7% under RM, got 125.0%); lower a frequency, or move a task to "
        "another RTPU"
    ]
    assert legality.loads(config)[0].guaranteed == ("t1", "t2")
    assert [problem.severity for problem in legality.check(config)] == ["warn"]
    three = configuration(*config.tasks[:3], rtpus=config.rtpus)
    (load,) = legality.loads(three)
    assert load.bound == pytest.approx(3 * (2 ** (1 / 3) - 1))
    assert load.critical_set == ("t1", "t2")
    assert texts(three) == [
        "arm0: on RTPU arm0 t3 may miss deadlines (expected a utilization of at most "
        "78.0% under RM, got 98.3%); lower a frequency, or move a task to another RTPU"
    ]
    two = configuration(*config.tasks[:2], rtpus=config.rtpus)
    assert legality.loads(two)[0].bound == pytest.approx(0.828, abs=1e-3)
    assert texts(two) == []


def test_rm_refuses_an_overload_that_hits_a_critical_task() -> None:
    config = figure_6_1("RM")
    third = config.tasks[2]
    marked = structs.replace(third, rmod=structs.replace(third.rmod, critical=True))
    tasks = (*config.tasks[:2], marked, config.tasks[3])
    (problem,) = legality.check(configuration(*tasks, rtpus=config.rtpus))
    assert problem.severity == "refuse"
    assert problem.what == "RTPU arm0 is too busy for the CRITICAL t3"
    assert problem.expected == (
        "CRITICAL tasks whose longest response is within their deadline"
    )


def test_rm_names_all_in_an_overload_of_which_nobody_is_safe() -> None:
    tasks = [task("a", freq=100, maxc=0.009), task("b", freq=99, maxc=0.009)]
    tasks = [structs.replace(t, rmod=structs.replace(t.rmod, crit=7)) for t in tasks]
    config = configuration(*tasks, rtpus=[rtpu(scheduler="RM")])
    (problem,) = legality.check(config)
    assert problem.severity == "warn"
    assert problem.what == "on RTPU arm0 a and b may miss deadlines"
    (problem,) = legality.check(structs.replace(config, strict=True))
    assert problem.severity == "refuse"
    assert (
        legality.check(structs.replace(figure_6_1("MUF"), strict=True))[0].severity
        == "warn"
    )


def test_rm_gives_the_faster_task_the_higher_criticality() -> None:
    entry = rtpu(scheduler="RM", minfreq=10.0, maxfreq=100.0)
    tasks = [task(f"hz{hz}", freq=hz) for hz in (5, 10, 25, 27, 100, 400)]
    found = crits(configuration(*tasks, rtpus=[entry]))
    assert found["hz5"] == found["hz10"] == 1
    assert found["hz100"] == found["hz400"] == 62
    assert 1 < found["hz25"] < found["hz27"] < 62


def test_how_coarse_the_scale_of_section_4_5_1_is() -> None:
    """Over four decades 62 values stand 16 percent apart: 25 and 30 Hz are neighbours.

    (The thesis gives the two as an example of equal criticality, for a scheduler whose
    number of values it leaves open; that takes 50 values or fewer.)
    """
    entry = rtpu(scheduler="RM", minfreq=0.1, maxfreq=1000.0)
    tasks = [task(f"hz{hz}", freq=hz) for hz in (25, 27, 30)]
    found = crits(configuration(*tasks, rtpus=[entry]))
    assert found["hz25"] == found["hz27"]
    assert found["hz30"] - found["hz25"] == 1


def test_rm_warns_of_rates_beyond_its_scale() -> None:
    entry = rtpu(scheduler="RM", minfreq=10.0, maxfreq=100.0)
    config = configuration(task("a", freq=5), task("b", freq=400), rtpus=[entry])
    assert texts(config) == [
        "a: task a runs at 5 Hz, beyond MINFREQ of RTPU arm0, and gets the criticality "
        "of that (expected 10 to 100 Hz, got 5 Hz); correct MINFREQ in the .sbs file, "
        "or the task's frequency",
        "b: task b runs at 400 Hz, beyond MAXFREQ of RTPU arm0, and gets the "
        "criticality of that (expected 10 to 100 Hz, got 400 Hz); correct MAXFREQ in "
        "the .sbs file, or the task's frequency",
    ]
    assert {problem.severity for problem in legality.check(config)} == {"warn"}


def test_an_unknown_maxc_makes_muf_assume() -> None:
    tasks = [task("a", freq=500, maxc=0.001), task("b", freq=100), task("c", freq=50)]
    config = configuration(*tasks, rtpus=[rtpu()])
    found = legality.criticalities(config.tasks, config.rtpus[0])
    assert [found[name].assumed for name in "abc"] == [False, True, True]
    assert {found[name].crit for name in "abc"} == {5}
    assert legality.loads(config)[0].unknown == ("b", "c")
    assert texts(config) == []


def test_what_is_known_may_be_too_much_already() -> None:
    tasks = [task("a", freq=500, maxc=0.0015), task("b", freq=100)]
    tasks.append(task("c", freq=500, maxc=0.0015))
    for scheduler in ("EDF", "RM"):
        config = configuration(*tasks, rtpus=[rtpu(scheduler=scheduler)])
        (problem,) = legality.check(config)
        assert problem.severity == "refuse"
        assert problem.got == "at least 150.0%"


def test_measured_times_and_other_frequencies_count() -> None:
    one = task("a", freq=500, maxc=0.003)
    one = legality.Task(rmod=one.rmod, rtpu="arm0", freq=100.0, maxc=0.001)
    (load,) = legality.loads(configuration(one, rtpus=[rtpu()]))
    assert load.utilization == pytest.approx(0.3)
    unsaid = task("a", freq=500)
    one = legality.Task(rmod=unsaid.rmod, rtpu="arm0", freq=100.0, maxc=0.001)
    (load,) = legality.loads(configuration(one, rtpus=[rtpu()]))
    assert load.utilization == pytest.approx(0.1)


def test_the_limit_keeps_room_on_the_core() -> None:
    config = configuration(
        task("a", freq=1000, maxc=0.00097),
        rtpus=[rtpu(scheduler="EDF")],
        core=CoreShare(share=0.95),
    )
    (problem,) = legality.check(config)
    assert problem.expected == "a utilization of at most 95.0% under EDF"
    assert problem.got == "97.0%"


def test_each_rtpu_has_its_own_load_and_off_tasks_none() -> None:
    tasks = [
        task("a", freq=100, maxc=0.006),
        task("b", freq=100, maxc=0.006, rtpu="arm1"),
        task("c", freq=100, maxc=0.006),
    ]
    rtpus = [rtpu("arm0"), rtpu("arm1")]
    first, second = legality.loads(configuration(*tasks, on={"a", "b"}, rtpus=rtpus))
    assert (first.rtpu, first.utilization) == ("arm0", pytest.approx(0.6))
    assert (second.rtpu, second.utilization) == ("arm1", pytest.approx(0.6))


def test_a_fixed_criticality_is_kept() -> None:
    tasks = [task("a", crit=17), task("b")]
    assert crits(configuration(*tasks, rtpus=[rtpu()])) == {"a": 17, "b": 5}


def test_servers_take_from_what_the_critical_set_may_use() -> None:
    tasks = [
        task("a", freq=100, maxc=0.006),
        task("b", freq=50, maxc=0.006),
        task("s", freq=100, capacity=0.002, tasktype=TaskType.DEFERRABLE),
        task("idle", freq=None, tasktype=TaskType.BACKGROUND),
    ]
    config = configuration(*tasks, rtpus=[rtpu()])
    assert crits(config) == {"a": 5, "b": 3, "s": 6, "idle": 1}
    (load,) = legality.loads(config)
    assert load.utilization == pytest.approx(0.6 + 0.3 + 0.2)
    without = configuration(*tasks[:2], tasks[3], rtpus=[rtpu()])
    assert crits(without) == {"a": 5, "b": 5, "idle": 1}


@pytest.mark.parametrize(("scheduler", "crit"), [("MUF", 6), ("EDF", 5), ("RM", 62)])
def test_a_server_without_a_rate(scheduler: str, crit: int) -> None:
    server = task("s", freq=None, tasktype=TaskType.SPORADIC)
    assert crits(configuration(server, rtpus=[rtpu(scheduler=scheduler)])) == {
        "s": crit
    }


def test_the_traffic_of_equations_6_and_7() -> None:
    tasks = (
        task("pid", invar="Q QD", outvar="T", freq=500, info=None),
        task("arm", invar="T", outvar="Q QD", freq=1000, info=None),
        task("idle", invar="Q", freq=None, info=None, tasktype=TaskType.BACKGROUND),
    )
    table = [Variable(name=name, type="double", nelem=6) for name in ("Q", "QD", "T")]
    config = configuration(*tasks, variables=table)
    assert legality.bytes_per_second(config) == {
        "pid": 3 * 48 * 500,
        "arm": 3 * 48 * 1000,
        "idle": 0,
    }
    assert texts(config) == []
    config = configuration(*tasks, variables=table, copy_speed=200e3)
    assert texts(config) == [
        "arm: the tasks transfer more data than the table can carry (expected at most "
        "0.2 MB/s (equation 7), got 0.216 MB/s, of which arm 0.144 MB/s); lower the "
        "frequency of arm, or combine it with the tasks that use it"
    ]


def test_traffic_is_judged_by_the_memory_of_each_machine() -> None:
    """144 kB/s of each task are too much for one memory of 200 kB/s, not for two."""
    tasks = [
        task(name, invar="Q QD", outvar=f"T{name}", freq=1000, info=None, rtpu=rtpu_)
        for name, rtpu_ in (("a", "arm0"), ("b", "arm1"))
    ]
    names = ("Q", "QD", "Ta", "Tb")
    table = [Variable(name=name, type="double", nelem=6) for name in names]
    entries = [rtpu("arm0"), rtpu("arm1")]

    def found(machines, speeds):
        config = configuration(
            *tasks,
            variables=table,
            rtpus=entries,
            machines=machines,
            copy_speeds=speeds,
        )
        return [p.got for p in legality.check(config) if p.code == "bandwidth"]

    both = {"arm0": 200e3, "arm1": 200e3}
    assert found({"arm0": "x", "arm1": "x"}, both) == [
        "0.288 MB/s, of which b 0.144 MB/s"
    ]
    assert found({"arm0": "x", "arm1": "y"}, both) == []
    assert found({"arm0": "x", "arm1": "y"}, both | {"arm1": 100e3}) == [
        "0.144 MB/s, of which b 0.144 MB/s"
    ]
    assert found({}, {}) == []  # 1 GB/s where nobody has measured


@pytest.mark.parametrize(
    ("given", "keyword", "more"),
    [
        ({"maxc": 0.02}, "MAXC", "; with SOFTNESS a cycle may continue into the next "),
        ({"maxc": 0.05, "effc": 0.02, "softness": 0.1}, "EFFC", ""),
        ({"minc": 0.02}, "MINC", ""),
        ({"capacity": 0.02, "tasktype": TaskType.SPORADIC}, "CAPACITY", ""),
    ],
)
def test_what_does_not_fit_the_period_is_refused(given, keyword, more) -> None:
    """At the frequency that counts, which may be the job's and not the RMOD's."""
    slow = task("a", freq=10, **given)
    assert texts(configuration(slow)) == []
    fast = legality.Task(rmod=slow.rmod, info=slow.info, rtpu="arm0", freq=100.0)
    (problem,) = legality.check(configuration(fast))
    assert (problem.code, problem.severity) == (legality.Code.TIMES, "refuse")
    assert legality.as_text(problem).startswith(
        f"a.rmod: {keyword} of task a is above its period (expected at most 0.01 s, "
        "the period at 100 Hz, got 0.02 s); lower the frequency to at most 50 Hz, or "
        f"correct {keyword}{more}"
    )


def test_a_soft_cycle_may_take_longer_than_a_period() -> None:
    made = task("a", freq=100, maxc=0.03, effc=0.005, softness=0.1)
    assert texts(configuration(made, rtpus=[rtpu()])) == []


def test_a_measured_time_above_the_declared_one_is_told() -> None:
    one = structs.replace(task("a", maxc=0.001), maxc=0.002)
    (problem,) = legality.check(configuration(one, rtpus=[rtpu()]))
    assert (problem.code, problem.severity) == (legality.Code.UNDERSTATED, "warn")
    assert legality.as_text(problem) == (
        "a.rmod: a cycle of task a took longer than its MAXC (expected at most 0.001 "
        "s, got 0.002 s as measured); 'pbonet adopt' writes the measured time, or find "
        "out why a takes so long"
    )


@pytest.mark.parametrize("scheduler", ["EDF", "RM", "MUF"])
def test_measured_times_refuse_nothing(scheduler: str) -> None:
    """They only warn: one slow cycle must not keep a job from starting again."""
    marks = {"critical": True, "info": None}
    declared = [task(name, freq=100, maxc=0.006, **marks) for name in "ab"]
    entry = rtpu(scheduler=scheduler)
    refused = legality.check(configuration(*declared, rtpus=[entry]))
    assert {problem.severity for problem in refused} == {"refuse"}
    measured = [
        structs.replace(task(name, freq=100, **marks), maxc=0.006) for name in "ab"
    ]
    (problem,) = legality.check(configuration(*measured, rtpus=[entry]))
    assert problem.severity == "warn"
    assert problem.got == "120.0% with measured times"
    third = structs.replace(task("c", freq=100), maxc=0.001)
    mixed = configuration(*declared, third, rtpus=[entry])
    assert "refuse" in {problem.severity for problem in legality.check(mixed)}


def test_a_server_beside_a_task_of_unknown_time() -> None:
    made = task("s", freq=100, capacity=0.002, tasktype=TaskType.DEFERRABLE)
    assert texts(configuration(task("a", freq=50), made, rtpus=[rtpu()])) == []


def test_measured_times_change_nobodys_criticality() -> None:
    """A slow cycle of another run must not take a task out of the critical set."""
    made = [
        structs.replace(task("a", freq=100, critical=True, info=None), maxc=0.05),
        task("b", freq=50, maxc=0.001),
    ]
    config = configuration(*made, rtpus=[rtpu()])
    assert crits(config) == {"a": 5, "b": 5}
    (load,) = legality.loads(config)
    assert load.critical_set == ("a", "b")
    assert load.guaranteed == ()
    (problem,) = legality.check(config)
    assert problem.severity == "warn"
    assert problem.tasks == ("a",)


def test_a_soft_task_is_ranked_by_its_measured_effective_time() -> None:
    profile = from_steps([(2_000_000, 0.9), (30_000_000, 1.0)])
    soft = structs.replace(task("s", freq=100, softness=0.1), profile=profile)
    config = configuration(soft, task("b", freq=50, maxc=0.01), rtpus=[rtpu()])
    assert crits(config) == {"s": 5, "b": 5}
    assert texts(config) == []
    hard = structs.replace(soft, rmod=structs.replace(soft.rmod, maxc=0.03))
    assert crits(configuration(hard, rtpus=[rtpu()])) == {"s": 5}


def test_a_rate_that_no_rtpu_grants_is_refused() -> None:
    """By the same bound that a spawn is refused for."""
    assert _rt.MIN_PERIOD_NS == times.SHORTEST_NS
    assert texts(configuration(task("a", freq=10_000))) == []
    (problem,) = legality.check(configuration(task("a", freq=10_001)))
    assert problem.severity == "refuse"
    assert legality.as_text(problem) == (
        "a.rmod: task a has a higher frequency than an RTPU supports (expected at "
        "most 10000 Hz, got "
        "10001 Hz); lower the frequency"
    )


def test_a_crit_that_takes_from_the_critical_set_is_named() -> None:
    """tau1 to tau3 of Figure 6.1 take 98.3 %; tau3 would be outside by the rule."""
    config = structs.replace(figure_6_1("MUF"), core=CoreShare(share=0.95))
    raised = structs.replace(
        config,
        tasks=tuple(
            structs.replace(t, rmod=structs.replace(t.rmod, crit=5))
            if t.name == "t3"
            else t
            for t in config.tasks
        ),
    )
    hint = "; take CRIT out of the RMOD of t3, lower a frequency, or move a task"
    assert [hint in text for text in texts(raised)] == [True]
    assert [hint in text for text in texts(config)] == [False]
