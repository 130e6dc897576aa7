"""MUF, EDF and RM as criticality rules, against hand-computed cases."""

import math

import pytest

from pbonet.analysis.schedule.criticality import (
    INSIDE,
    OUTSIDE,
    Timing,
    edf,
    liu_layland,
    muf,
    rate_monotonic,
    rm,
)

FIGURE_6_1 = [
    Timing(name="t1", period=6, maxc=2),
    Timing(name="t2", period=10, maxc=4),
    Timing(name="t3", period=12, maxc=3),
    Timing(name="t4", period=15, maxc=4),
]


def test_muf_puts_the_first_three_of_figure_6_1_into_the_critical_set() -> None:
    got = muf(FIGURE_6_1)
    assert [got[f"t{i}"].crit for i in (1, 2, 3, 4)] == [5, 5, 5, 3]
    assert got["t3"].utilization == pytest.approx(2 / 6 + 4 / 10 + 3 / 12)
    assert not any(task.assumed for task in got.values())


def test_muf_takes_shorter_periods_first_whatever_the_order_given() -> None:
    assert muf(reversed(FIGURE_6_1)) == muf(FIGURE_6_1)


def test_muf_ends_the_set_at_the_first_task_that_does_not_fit() -> None:
    got = muf([
        Timing(name="a", period=1, maxc=0.6),
        Timing(name="b", period=2, maxc=1.0),
        Timing(name="c", period=3, maxc=0.1),
    ])
    assert {name: task.crit for name, task in got.items()} == {"a": 5, "b": 3, "c": 3}


def test_muf_fills_the_core_to_the_brim() -> None:
    tenth = [Timing(name=f"t{i}", period=0.1 * 3, maxc=0.01 * 3) for i in range(10)]
    assert all(task.in_set for task in muf(tenth).values())


def test_muf_says_what_is_assumed() -> None:
    got = muf([
        Timing(name="a", period=1, maxc=0.5),
        Timing(name="b", period=2),
        Timing(name="c", period=3, maxc=0.3),
        Timing(name="d", period=4, maxc=3.9),
        Timing(name="e", period=5, crit=7),
    ])
    assert {name: task.assumed for name, task in got.items()} == {
        "a": False, "b": True, "c": True, "d": True, "e": False,
    }  # fmt: skip
    assert {name: task.crit for name, task in got.items()} == {
        "a": INSIDE, "b": INSIDE, "c": INSIDE, "d": OUTSIDE, "e": 7,
    }  # fmt: skip


def test_muf_honours_the_limit() -> None:
    tasks = [Timing(name="a", period=1, maxc=0.96)]
    assert muf(tasks)["a"].crit == INSIDE
    assert muf(tasks, limit=0.95)["a"].crit == OUTSIDE


def test_edf_gives_all_the_same() -> None:
    assert {task.crit for task in edf(FIGURE_6_1).values()} == {INSIDE}


@pytest.mark.parametrize(
    ("freq", "crit"),
    [(0.01, 1), (1, 1), (1000, 62), (5000, 62), (1000**0.5, 32), (1.01, 1), (999, 62)],
)
def test_rm_over_the_default_range(freq: float, crit: int) -> None:
    assert rm(freq) == crit


def test_rm_is_logarithmic_and_uses_all_62_values() -> None:
    seen = [rm(10 ** (i / 1000), 1, 1000) for i in range(-1000, 4000)]
    assert seen == sorted(seen)
    assert set(seen) == set(range(1, 63))


def test_rm_tells_25_from_27_hz_between_10_and_100() -> None:
    """The thesis's second example of section 4.5.1."""
    assert rm(25, 10, 100) != rm(27, 10, 100)


def test_rate_monotonic_finds_the_critical_set_of_figure_6_1() -> None:
    got = rate_monotonic(FIGURE_6_1, minfreq=0.05, maxfreq=0.5)
    crits = [got[f"t{i}"].crit for i in (1, 2, 3, 4)]
    assert crits == sorted(crits, reverse=True)
    assert len(set(crits)) == 4
    assert [got[f"t{i}"].in_set for i in (1, 2, 3, 4)] == [True, True, False, False]


def test_liu_layland_bounds() -> None:
    assert liu_layland(1) == 1
    assert liu_layland(2) == pytest.approx(0.8284, abs=1e-4)
    assert liu_layland(10**6) == pytest.approx(math.log(2), abs=1e-6)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: muf([Timing(name="a", period=0)]), "period 0 s is not above zero"),
        (lambda: muf([Timing(name="a", period=math.nan)]), "is not above zero"),
        (lambda: edf([Timing(name="a", period=1, maxc=-1)]), "MAXC -1 s is below"),
        (lambda: muf([], limit=0), "limit 0 is not within"),
        (lambda: rm(1, 10, 10), "MINFREQ 10 Hz and MAXFREQ 10 Hz span no range"),
        (lambda: rm(0), "frequency 0 Hz is not above zero"),
        (lambda: liu_layland(0), "0 tasks have no bound"),
    ],
)
def test_nonsense_is_refused(call: object, text: str) -> None:
    assert callable(call)
    with pytest.raises(ValueError, match=text.replace("(", r"\(")):
        call()
