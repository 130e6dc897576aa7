"""The report on every RTPU, and a configuration in virtual time."""

import json

import pytest
from msgspec import structs
from verify_parts import (
    MS,
    PROFILE,
    configuration,
    figure_6_1,
    rtpu,
    task,
    texts,
    with_server,
)

from pbonet.analysis import legality
from pbonet.analysis.schedule import CoreShare
from pbonet.config.model import TaskType
from pbonet.errors import VerificationError


def only(config: legality.Configuration) -> legality.RtpuReport:
    (found,) = legality.report(config)
    return found


def test_figure_6_1_under_each_scheduler() -> None:
    muf = only(figure_6_1("MUF"))
    assert muf.outlook is legality.Outlook.PARTLY
    assert muf.critical_set == muf.guaranteed == ("t1", "t2", "t3")
    assert [t.guaranteed for t in muf.tasks] == [True, True, True, False]
    assert only(figure_6_1("EDF")).outlook is legality.Outlook.UNKEPT
    rm = only(figure_6_1("RM"))
    assert rm.outlook is legality.Outlook.PARTLY
    assert rm.guaranteed == ("t1", "t2")
    assert rm.critical_set == rm.guaranteed == ("t1", "t2")
    assert [t.response for t in rm.tasks] == [0.002, 0.006, None, None]
    assert not any(rm.by_scheduler.values())


def test_three_tasks_that_muf_and_edf_keep_and_rm_does_not() -> None:
    config = figure_6_1("MUF")
    three = only(configuration(*config.tasks[:3], rtpus=config.rtpus))
    assert three.outlook is legality.Outlook.SCHEDULABLE
    assert three.by_scheduler == {
        "MUF": True,
        "EDF": True,
        "RM": False,
        "RM bound": False,
    }


def test_rm_keeps_more_than_equation_9_promises() -> None:
    tasks = [task("a", freq=500, maxc=0.001), task("b", freq=250, maxc=0.002)]
    config = configuration(*tasks, rtpus=[rtpu(scheduler="RM")])
    assert texts(config) == []
    found = only(config)
    assert found.outlook is legality.Outlook.SCHEDULABLE
    assert found.critical_set == ("a",)
    assert found.guaranteed == ("a", "b")
    assert (found.by_scheduler["RM"], found.by_scheduler["RM bound"]) == (True, False)


def test_where_every_time_comes_from() -> None:
    both = task("d", minc=0.0002, maxc=0.003)
    tasks = [
        structs.replace(task("m"), minc=0.0001, maxc=0.001),
        structs.replace(both, minc=0.0001, maxc=0.001),
        task("n"),
        structs.replace(task("p", softness=0.1), profile=PROFILE),
        task("s", softness=0.1, maxc=0.001),
        structs.replace(task("g", softness=0.1, effc=0.004), profile=PROFILE),
        structs.replace(task("c", softness=0.01, maxc=0.009), profile=PROFILE),
    ]
    found = {t.task: t for t in only(configuration(*tasks, rtpus=[rtpu()])).tasks}

    def figures(name: str) -> list[tuple[float | None, str]]:
        one = found[name]
        times = [one.minc, one.maxc, *([one.effective] if one.effective else [])]
        return [(time.seconds, time.source.value) for time in times]

    assert figures("m") == [(0.0001, "measured"), (0.001, "measured")]
    assert figures("d") == [(0.0002, "rmod"), (0.003, "rmod")]
    assert figures("n") == [(None, "assumed"), (None, "assumed")]
    assert figures("p") == [(None, "assumed"), (0.01, "measured"), (0.006, "measured")]
    assert figures("s") == [(None, "assumed"), (0.001, "rmod"), (0.001, "assumed")]
    assert figures("g") == [(None, "assumed"), (0.01, "measured"), (0.004, "rmod")]
    assert figures("c") == [(None, "assumed"), (0.009, "rmod"), (0.009, "measured")]


def test_unknown_times_make_a_verdict_assumed() -> None:
    found = only(configuration(task("a"), task("b", maxc=0.001), rtpus=[rtpu()]))
    assert found.outlook is legality.Outlook.ASSUMED
    assert found.unknown == ("a",)
    assert only(configuration(rtpus=[rtpu()])).outlook is legality.Outlook.IDLE


def test_a_soft_task_is_counted_with_its_effective_time() -> None:
    """T 12, C 10, E 6 of section 6.4: 50 percent, and one of every two cycles."""
    found = only(with_server())
    soft = found.tasks[0]
    assert soft.utilization == pytest.approx(0.5)
    assert soft.every == 2
    assert soft.on_time == pytest.approx(0.9 / 1.1)
    assert found.utilization == pytest.approx(0.5 + 0.1 + 0.2)
    assert found.outlook is legality.Outlook.SCHEDULABLE


def test_a_server_and_how_large_it_may_be() -> None:
    (server,) = only(with_server()).servers
    assert server.size == pytest.approx(0.2)
    assert server.equation == 22
    assert server.by_equation == pytest.approx(0.4 / 2.2)
    assert server.largest == pytest.approx(0.0025)
    assert server.fits
    rm = structs.replace(with_server(), rtpus=(rtpu(scheduler="RM"),))
    assert only(rm).servers[0].equation == 12


def test_a_server_that_is_too_large_is_said_to_be() -> None:
    tasks = [
        task("a", freq=100, maxc=0.006, critical=True, info=None),
        task("s", freq=100, capacity=0.003, tasktype=TaskType.DEFERRABLE),
    ]
    (said,) = only(configuration(*tasks, rtpus=[rtpu()])).servers
    assert not said.fits
    assert said.by_equation == pytest.approx(0.4 / 2.2)  # beside what it pushes out
    refusal = (
        "s.rmod: the server s is larger than RTPU arm0 can bear: a may miss deadlines "
        "(expected at most 0.002 s, once in 0.01 s, got 0.003 s); lower CAPACITY, "
        "lower a frequency, or move a task to another RTPU"
    )
    plain = task("a", freq=100, maxc=0.006)
    for first in (tasks[0], plain):
        config = configuration(first, tasks[1], rtpus=[rtpu()])
        assert texts(config) == [refusal]
        assert legality.check(config)[0].severity == "refuse"
        assert only(config).outlook is legality.Outlook.OVERLOADED
    smaller = task("s", freq=100, capacity=0.002, tasktype=TaskType.DEFERRABLE)
    assert texts(configuration(plain, smaller, rtpus=[rtpu()])) == []
    limited = configuration(plain, tasks[1], rtpus=[rtpu()], core=CoreShare(share=0.7))
    assert "expected at most 0.001 s, once in 0.01 s" in texts(limited)[0]


def test_servers_alone_may_be_too_large() -> None:
    made = [
        task(name, freq=100, capacity=0.006, tasktype=TaskType.SPORADIC)
        for name in "st"
    ]
    (problem,) = legality.check(configuration(*made, rtpus=[rtpu()]))
    assert (problem.code, problem.severity) == (legality.Code.SERVER, "refuse")
    assert problem.what == "the servers s and t are larger than RTPU arm0 can bear"


def test_a_fixed_criticality_may_spoil_the_critical_set() -> None:
    config = figure_6_1("MUF", crit=5)
    found = only(config)
    assert found.critical_set == ("t1", "t2", "t3")
    assert found.guaranteed == ()
    assert "t1 and t2 and t3 and t4 may miss deadlines" in texts(config)[0]


def test_nothing_is_guaranteed_beyond_the_limit() -> None:
    for crit in (None, 20):
        heavy = task("a", freq=999, maxc=0.001, critical=True, info=None, crit=crit)
        config = configuration(heavy, rtpus=[rtpu()], core=CoreShare(share=0.95))
        assert only(config).guaranteed == ()
        assert "too busy for the CRITICAL a" in texts(config)[0]
        assert texts(configuration(heavy, rtpus=[rtpu()])) == []


def test_a_fixed_criticality_may_guarantee_what_the_rule_would_not() -> None:
    """The slow task of Figure 6.1, above all others: then it is t3 that may miss."""
    config = figure_6_1("MUF", crit=6, critical=True, info=None)
    assert only(config).guaranteed == ("t4",)
    assert "t1 and t2 and t3 may miss deadlines" in texts(config)[0]


def test_a_transformation_is_proposed() -> None:
    (change,) = only(figure_6_1("MUF", critical=True)).transformations
    assert (change.name, change.factor) == ("t4", 2)


def test_the_report_as_text() -> None:
    assert legality.report_text(legality.report(with_server())).splitlines() == [
        "RTPU arm0 (MUF): schedulable, utilization 80.0% of 100.0%",
        "  core: 100.0% for tasks (virtual time)",
        "  critical set: a soft",
        "  all deadlines would be met under: MUF, EDF, RM",
        "  server srv: deferrable, 2 ms every 10 ms (20.0%); equation 22 allows 18.2%, "
        "all periods known 2.5 ms; fits",
        "  table: 0 of 1000 MB/s (assumed); a write waits 0 s, a read 0 us at most",
        "  task  Hz       MINC ms      MAXC ms      E ms        U %   crit  set  meets",
        "  soft  83.3333  ? assumed 0  10 measured  6 measured  50.0  5     yes  1 "
        "of 2 cycles, 81.8% of periods at worst",
        "  a     100      0.5 .rmod    1 .rmod      -           10.0  5     yes  every "
        "deadline",
        "  srv   100      -            -            -           20.0  6     no   -",
        "  idle  -        -            -            -           0.0   1     no   -",
    ]


def test_the_report_as_data() -> None:
    reports = legality.report(figure_6_1("MUF", critical=True))
    (data,) = json.loads(json.dumps(legality.report_data(reports)))
    assert data["outlook"] == "overloaded"
    assert data["tasks"][0]["maxc"] == {"seconds": 0.002, "source": "rmod"}
    assert data["transformations"][0]["factor"] == 2


def test_a_job_in_virtual_time_gives_figure_6_1() -> None:
    late = {"MUF": {"t4"}, "RM": {"t3", "t4"}}
    for scheduler, expected in late.items():
        outcome = legality.simulate_job(figure_6_1(scheduler), seconds=0.72)
        assert outcome.missing == expected
    edf = legality.simulate_job(figure_6_1("EDF"), seconds=0.72)
    assert edf.missing - {"t4"}
    text = legality.simulate_job(figure_6_1("MUF"), seconds=0.06).as_text()
    assert "RTPU arm0: 100.0% used in 0.06 s; missed deadlines: t4" in text
    assert "t4 ····" in text
    assert "releases  cycles  missed" in text


def test_a_job_with_a_soft_task_and_a_server() -> None:
    worst = legality.simulate_job(with_server(), seconds=1.2)
    account = worst.rtpus["arm0"].tasks["soft"]
    assert (account.cycles, account.missed) == (50, 50)
    assert worst.missing == {"soft"}
    assert worst.rtpus["arm0"].tasks["srv"].cycles == 120
    first = legality.simulate_job(
        with_server(), seconds=12, times=legality.Times.RANDOM, seed=3
    )
    again = legality.simulate_job(
        with_server(), seconds=12, times=legality.Times.RANDOM, seed=3
    )
    other = legality.simulate_job(
        with_server(), seconds=12, times=legality.Times.RANDOM, seed=4
    )
    assert first.as_data() == again.as_data() != other.as_data()
    done = first.rtpus["arm0"].tasks["soft"]
    assert done.overruns / done.cycles == pytest.approx(0.1, abs=0.03)
    assert 0 < first.rtpus["arm0"].tasks["a"].cpu_ns < 1200 * MS


def test_events_of_servers_and_background_tasks() -> None:
    outcome = legality.simulate_job(
        with_server(),
        seconds=0.1,
        events={"srv": [(5 * MS, MS)], "idle": [(0, 7 * MS)]},
    ).rtpus["arm0"]
    assert outcome.tasks["srv"].responses_ns == [MS]
    assert outcome.tasks["idle"].cycles == 1


def test_unknown_times_are_refused_or_assumed() -> None:
    config = configuration(task("a"), rtpus=[rtpu()])
    with pytest.raises(VerificationError) as caught:
        legality.simulate_job(config, seconds=1)
    assert str(caught.value) == (
        "a: the execution time of a is not known (expected MAXC in the .rmod, or a "
        "measured profile, got neither); declare MAXC, measure it with 'pbonet run "
        "--profile', or give the share of a period to assume: --assume 0.1"
    )
    outcome = legality.simulate_job(config, seconds=1, assume=0.25)
    assert outcome.rtpus["arm0"].utilization == pytest.approx(0.25)
    assert outcome.as_text().endswith("execution times assumed: a")
    with pytest.raises(VerificationError, match="needs time"):
        legality.simulate_job(config, seconds=0)


def test_every_rtpu_has_its_chart_and_its_picture() -> None:
    tasks = [task("a", maxc=0.002), task("b", maxc=0.012, rtpu="arm1")]
    config = configuration(*tasks, rtpus=[rtpu("arm0"), rtpu("arm1"), rtpu("arm2")])
    outcome = legality.simulate_job(config, seconds=0.1)
    assert outcome.missing == {"b"}
    assert list(outcome.rtpus) == ["arm0", "arm1", "arm2"]
    pictures = outcome.svg()
    assert set(pictures) == {"arm0", "arm1"}
    assert "RTPU arm1: missed deadlines: b" in pictures["arm1"]
    assert "RTPU arm0: no deadline was missed" in pictures["arm0"]
    assert json.dumps(outcome.as_data(segments=False))
