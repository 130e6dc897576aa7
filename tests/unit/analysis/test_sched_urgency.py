"""The urgency value and the levels that stand for it."""

import itertools

import pytest
from plain_dispatcher.levels import HIGH, LOW, assign_levels

from pbonet.analysis.schedule.urgency import NEVER, urgency


def test_criticality_comes_before_deadline_before_priority() -> None:
    ranked = sorted(
        itertools.product((3, 5), (10, 20, NEVER), (0, 7)),
        key=lambda task: -urgency(*task),
    )
    assert ranked == [
        (5, 10, 7), (5, 10, 0), (5, 20, 7), (5, 20, 0), (5, NEVER, 7), (5, NEVER, 0),
        (3, 10, 7), (3, 10, 0), (3, 20, 7), (3, 20, 0), (3, NEVER, 7), (3, NEVER, 0),
    ]  # fmt: skip


def test_no_deadline_is_a_dynamic_priority_of_zero() -> None:
    assert urgency(0, NEVER, 0) == 0


@pytest.mark.parametrize(
    ("task", "text"),
    [
        ((64, 0, 0), "criticality 64 is not within 0 to 63"),
        ((0, -1, 0), "deadline -1 ns is not within"),
        ((0, 0, 65536), "user priority 65536 is not within 0 to 65535"),
    ],
)
def test_values_out_of_range_are_refused(task, text) -> None:
    with pytest.raises(ValueError, match=text):
        urgency(*task)


def test_levels_that_fit_are_kept() -> None:
    assert assign_levels([80, 44, 9]) == [80, 44, 9]


def test_a_newcomer_takes_the_gap_and_moves_nobody() -> None:
    assert assign_levels([80, 0, 9]) == [80, 45, 9]


def test_one_task_alone_stands_in_the_middle() -> None:
    assert assign_levels([0]) == [46]


def test_without_a_gap_as_few_as_possible_move() -> None:
    held = [60, 0, 59, 58, 57]
    levels = assign_levels(held)
    assert sum(a != b for a, b in zip(held, levels, strict=True)) == 2
    assert levels == sorted(set(levels), reverse=True)


def test_a_reversal_moves_all_but_one() -> None:
    held = [10, 20, 30]
    levels = assign_levels(held)
    assert levels == sorted(levels, reverse=True)
    assert sum(a == b for a, b in zip(held, levels, strict=True)) == 1


def test_more_tasks_than_levels_share_the_lowest() -> None:
    levels = assign_levels([0] * 100)
    assert levels[:77] == list(range(HIGH, LOW, -1))
    assert levels[77:] == [LOW] * 23


def test_as_many_tasks_as_levels_fill_them() -> None:
    assert assign_levels([0] * 78) == list(range(HIGH, LOW - 1, -1))


def test_none_is_none() -> None:
    assert assign_levels([]) == []
