"""Status fields: what they mean, and what "since the last status" is."""

from __future__ import annotations

import pytest
from msgspec import structs

from pbonet.master.subsystem import status_fields
from pbonet.master.subsystem.profiling import rtpu_data
from pbonet.master.subsystem.status_fields import Baselines, delay_quantile
from pbonet.xm.net.messages import RtpuStatus, SectionStatus, TaskStatus

THESIS = [
    *("rmod", "rtpu", "tid", "S", "crit", "state", "cycle", "miss", "refF", "refT"),
    *("mezF", "mezT", "ptime", "totC", "tick", "minU", "maxU", "avgU"),
    *("minC", "maxC", "avgC", "warn"),
]


def status(**changes):
    base = TaskStatus(
        rmod="pid",
        task="pid",
        rtpu="arm0",
        tid=7,
        S="P",
        crit=5,
        crit_assumed=False,
        state="ON",
        cycle=1000,
        miss=10,
        ref_f=500.0,
        mez_f=0.0,
        mez_t=0.0,
        ptime=2.0,
        on_ns=5,
        tot_c=0.4,
        tick=1e-9,
        min_c=0.0002,
        max_c=0.001,
        last_c=0.0003,
        warn=2,
        warning="late",
        transfer_in=8e-6,
        transfer_out=4e-6,
    )
    return structs.replace(base, **changes)


RAW = {
    "nc": "cycle",
    "nm": "miss",
    "qc": "nowC",
    "qt": "totC",
    "qmax": "maxC",
    "qmin": "minC",
    "qf": "firstC",
}
"""What section 6.7.1 collects of each task, and the field that shows it."""
DERIVED = (
    *("ptime", "cycle", "miss", "mezF", "mezT", "totC", "minC", "maxC", "avgC"),
    *("minU", "maxU", "avgU", "tick"),
)
"""What it computes from that; its resolution is the field `tick`."""


def fields(now, before=None):
    return status_fields.profile(now, before).fields


def test_load_is_that_of_the_last_second():
    """Half a core since it was turned on, a tenth of it in the last second."""
    window = status_fields.Window()
    first = status(now=10_000_000_000, ptime=4.0, tot_c=2.0)
    window.rates(first)
    assert window.load([first]) == pytest.approx(0.5)
    later = status(now=11_000_000_000, ptime=5.0, tot_c=2.1, cycle=1500)
    window.rates(later)
    resting = status(task="traj", state="OFF")
    window.rates(resting)
    assert window.load([later, resting]) == pytest.approx(0.1)
    assert window.rates(later)["cycle"] == 500


def test_every_field_of_section_4_4_1_is_there_in_its_order():
    assert list(status_fields.NAMES[: len(THESIS)]) == THESIS
    assert list(fields(status())) == list(status_fields.NAMES)


def test_every_figure_of_section_6_7_1_is_there_for_a_task():
    found = fields(status(first_c=0.003, now_c=0.0001))
    assert all(found[name] is not None for name in (*RAW.values(), *DERIVED))
    assert (found["firstC"], found["nowC"]) == (0.003, 0.0001)


def test_every_figure_of_section_6_7_1_is_there_for_an_rtpu():
    both = [
        status(first_c=0.003, now_c=0.0001),
        status(task="traj", cycle=500, ref_f=250.0, tot_c=0.1, first_c=0.001),
    ]
    core = RtpuStatus(rtpu="arm0", backend="fifo", scheduler="MUF", tasks=both)
    tasks = [
        {"rtpu": "arm0", "figures": fields(both[0])},
        {"rtpu": "arm0", "figures": fields(both[1])},
        {"rtpu": "arm1", "figures": fields(both[1])},
    ]
    found = rtpu_data(core, tasks)
    assert all(found[name] is not None for name in (*RAW.values(), *DERIVED))
    assert (found["cycle"], found["miss"], found["firstC"]) == (1500, 20, 0.003)
    assert found["avgC"] == pytest.approx(0.5 / 1500)
    assert found["mezF"] == pytest.approx(1500 / 2.0)
    assert rtpu_data(core, [])["avgC"] is None


def test_since_on_when_nothing_was_seen_before():
    found = fields(status())
    assert (found["cycle"], found["miss"], found["warn"]) == (1000, 10, 2)
    assert found["mezF"] == 500.0
    assert found["mezT"] == pytest.approx(2.0 / 1010)
    assert found["refT"] == 0.002


def test_failed_cycles_are_counted_apart_from_missed_ones():
    now = status(cycle=1500, miss=30, failed=20, ptime=3.0, tot_c=0.9)
    found = fields(now, status(failed=5))
    assert (found["miss"], found["failed"]) == (20, 15)
    assert found["mezT"] == pytest.approx(1.0 / 535)
    assert fields(status(), status(failed=5))["failed"] == 0, "turned on again"
    assert "failed" in status_fields.DEFAULT


def test_utilization_of_a_cycle_divides_by_the_period():
    found = fields(status())
    assert found["minU"] == pytest.approx(10.0)
    assert found["maxU"] == pytest.approx(50.0)
    assert found["avgU"] == pytest.approx(20.0)
    longer = fields(status(cycle=2000, tot_c=0.8, ptime=4.0))
    assert longer["avgU"] == found["avgU"]  # it does not shrink with time


def test_second_status_is_since_the_first():
    before = status()
    now = status(cycle=1500, miss=30, ptime=3.0, tot_c=0.9, warn=3)
    found = fields(now, before)
    assert (found["cycle"], found["miss"], found["warn"]) == (500, 20, 1)
    assert found["ptime"] == pytest.approx(1.0)
    assert found["totC"] == pytest.approx(0.5)
    assert found["avgC"] == pytest.approx(0.001)
    assert found["mezF"] == pytest.approx(500.0)
    assert found["maxC"] == 0.001  # extremes are since on


@pytest.mark.parametrize(
    "change",
    [{"tid": 8}, {"on_ns": 6}, {"cycle": 999}, {"ptime": 1.9}, {"tot_c": 0.3}],
)
def test_task_that_was_turned_on_again_is_counted_from_then(change):
    now = status(**change)
    assert fields(now, status()) == fields(now)


def test_nothing_to_divide_by_gives_no_value():
    found = fields(
        status(state="OFF", cycle=0, miss=0, ptime=0.0, tot_c=0.0, ref_f=0.0)
    )
    for name in ("mezF", "mezT", "avgC", "avgU", "minC", "maxU", "refF", "refT"):
        assert found[name] is None, name


def test_task_without_a_rate_takes_its_measured_period():
    found = fields(status(ref_f=0.0, cycle=100, miss=0, ptime=1.0, tot_c=0.1))
    assert found["avgU"] == pytest.approx(10.0)


def test_assumed_criticality_is_marked():
    assert fields(status(crit_assumed=True))["crit"] == "5?"
    assert fields(status())["crit"] == 5


def test_warning_is_shown_once_and_error_as_long_as_it_stands():
    seen = Baselines()
    failed = status(state="ERROR", error="q is not finite")
    first, second = seen.since([failed])[0], seen.since([failed])[0]
    assert first.warning == "late"
    assert second.warning == ""
    assert first.error == second.error == "q is not finite"
    assert seen.since([status(state="OFF", error="old")])[0].error == ""


def test_each_interface_has_its_own_baseline():
    one, other = Baselines(), Baselines()
    one.since([status()])
    later = status(cycle=1100, ptime=2.2, tot_c=0.5)
    assert one.since([later])[0].fields["cycle"] == 100
    assert other.since([later])[0].fields["cycle"] == 1100
    one.forget()
    assert one.since([later])[0].fields["cycle"] == 1100


def test_transfer_share_is_of_the_whole_time():
    # 12 us of 400 us a cycle
    assert fields(status())["xfer"] == pytest.approx(3.0)


def test_quantile_of_the_histogram_is_an_upper_edge():
    histogram = [0, 0, 50, 49, 0, 1]  # below 4, 8 and 32 us
    assert delay_quantile(histogram, 0.5) == pytest.approx(4e-6)
    assert delay_quantile(histogram, 0.99) == pytest.approx(8e-6)
    assert delay_quantile(histogram, 1.0) == pytest.approx(32e-6)
    assert delay_quantile([], 0.5) is None


FAILED = {
    "failures": {"deadline": 2, "maxexec": 3, "minexec": 0},
    "overruns": 3,
    "aborted": 1,
    "handlers": 5,
    "rank": 3,
    "reserve": 0.004,
    "delivery_max": 35e-6,
}


def test_timing_failures_are_told_since_the_last_status():
    seen = Baselines()
    quiet = seen.since([status(rank=5)])[0]
    assert (quiet.timing, quiet.fields["fail"]) == ("", 0)
    failed = seen.since([status(**FAILED)])[0]
    assert failed.timing == "2 deadline, 3 maxexec, 1 aborted, criticality 3 now"
    shown = [failed.fields[n] for n in ("fail", "over", "abort", "skip", "handler")]
    assert shown == [5, 3, 1, 0, 5]
    assert (failed.fields["rank"], failed.fields["told"]) == (3, 35e-6)
    again = seen.since([status(**FAILED, on_ns=6)])[0]  # off and on: the same process
    assert (again.timing, again.fields["fail"]) == ("", 0)
    other = seen.since([status(**FAILED, tid=8)])[0]
    assert other.fields["fail"] == 5


def test_a_server_without_failures_tells_of_its_capacity():
    found = status_fields.profile(status(overruns=4, rank=5, S="S"))
    assert found.timing == "4 capacity used up"


def test_a_device_that_is_too_fast_is_told_beside_what_failed():
    failures = {"deadline": 0, "maxexec": 1, "minexec": 0}
    found = status_fields.profile(status(overruns=3, failures=failures, rank=5, S="Y"))
    assert found.timing == "1 maxexec, 2 events far too early"


def test_timed_sections_have_a_mean():
    section = SectionStatus(count=4, total=0.002, min=0.0004, max=0.0006)
    found = fields(status(sections={"jacobian": section}))
    assert found["sections"] == "jacobian 4 x 0.5 ms"
