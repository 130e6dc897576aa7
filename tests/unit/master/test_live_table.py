"""The live table: rows from one reading, order, filter and keys; no terminal."""

from __future__ import annotations

import pytest
from test_explain import agent, rtpus, status, value

from pbonet.errors import StateError
from pbonet.master.configuration import Place
from pbonet.master.operating.live_table import watch
from pbonet.master.operating.table_rows import COLUMNS, Reading, all_rows, text_of
from pbonet.master.operating.table_view import VIEWS, TableView
from pbonet.master.subsystem import Window


@pytest.fixture
def reading():
    """Three tasks, one of them in ERROR with the flag; RTPU arm2 is away."""
    there = rtpus(
        status("sensor", miss=7, cycle=10),
        status("plan", "arm1", state="ERROR"),
        status("pid", miss=2, max_c=0.005),
        illegal=["the input REF of pid is stale (arm0/pid)"],
    )
    return Reading(
        rtpus=list(there.values()),
        silent={"arm2": "arm2: no agent"},
        agents={"arm0": agent("arm0"), "arm1": agent("arm1", "lab2")},
        values=[
            value("Q", "arm0/sensor", 0.01),
            value("REF", "arm1/plan", 3.0, stale=True),
        ],
        inputs={"plan": ["Q"], "pid": ["REF", "Q"]},
    )


def cells(row, view):
    columns = COLUMNS[view]
    return {
        column.name: text_of(column, cell)
        for column, cell in zip(columns, row.cells, strict=True)
    }


def test_a_task_has_its_machine_ages_and_flags(reading):
    rows = {row.name: row for row in all_rows(reading, Window())["tasks"]}
    pid = cells(rows["pid"], "tasks")
    assert (pid["machine"], pid["input age"]) == ("lab1", "3 s")
    assert (pid["stale"], pid["flags"]) == ("1", "1")
    assert (rows["pid"].mark, rows["sensor"].mark) == ("bad", "")
    plan = cells(rows["plan"], "tasks")
    assert (plan["machine"], plan["state"], plan["Hz"]) == ("lab2", "ERROR", "-")


def test_an_rtpu_that_is_away_has_a_row(reading):
    rows = {row.name: row for row in all_rows(reading, Window())["RTPUs"]}
    assert set(rows) == {"arm0", "arm1", "arm2"}
    assert cells(rows["arm2"], "RTPUs")["state"] == "away"
    assert cells(rows["arm0"], "RTPUs")["missed"] == "9"


def test_a_variable_has_its_writer_and_age(reading):
    rows = {row.name: row for row in all_rows(reading, Window())["variables"]}
    assert cells(rows["REF"], "variables") == {
        "variable": "REF",
        "writer": "arm1/plan",
        "age": "3 s",
        "stale": "1",
        "unit": "",
    }
    assert rows["REF"].mark == "bad"


@pytest.fixture
def shown(reading):
    """Give the names of the rows that a view shows after keys."""
    every = all_rows(reading, Window())

    def names(view, *keys):
        for key in keys:
            view.shown(every[view.view])
            view.press(key)
        return [row.name for row in view.shown(every[view.view])]

    return names


def test_rows_are_sorted_by_a_column_and_those_without_a_value_come_last(shown):
    view = TableView("missed")
    assert shown(view) == ["plan", "pid", "sensor"]
    assert shown(view, "r") == ["sensor", "pid", "plan"]
    assert shown(TableView("Hz"))[-1] == "plan"


def test_s_goes_through_the_columns(shown):
    view = TableView()
    assert shown(view) == ["sensor", "pid", "plan"]
    shown(view, "s")
    assert view.sort == "task"
    assert shown(view) == ["pid", "plan", "sensor"]
    shown(view, *["s"] * len(COLUMNS["tasks"]))
    assert view.sort == ""


def test_a_filter_is_typed(shown):
    view = TableView()
    assert shown(view, "/", "E", "R", "R") == ["plan"]
    assert shown(view, "q") == [], "a letter of the filter, which ends nothing"
    assert not view.ended
    shown(view, "backspace", "enter")
    assert (view.typing, view.wanted) == (False, "ERR")
    assert len(shown(view, "/", "escape")) == 3


def test_the_arrows_select_and_enter_asks(shown):
    view = TableView()
    shown(view, "down", "down", "down", "up", "enter")
    assert view.asked is not None
    assert (view.asked.kind, view.asked.name) == ("task", "pid")
    shown(view, "escape")
    assert view.asked is None


def test_the_selected_row_stays_when_the_order_changes(shown):
    view = TableView()
    shown(view, "down")
    assert view.place == 1
    shown(view, "s")
    assert shown(view)[view.place] == "pid"


def test_tab_shows_each_view_and_q_ends(shown):
    view = TableView()
    seen = [view.view]
    for _ in VIEWS[1:]:
        shown(view, "tab")
        seen.append(view.view)
    assert tuple(seen) == VIEWS
    shown(view, "q")
    assert view.ended


def test_an_unknown_column_is_refused(puma):
    with pytest.raises(StateError, match="did you mean missed"):
        watch(
            puma,
            Place(),
            sort="mised",
            wanted="",
            every=None,
            count=1,
            as_data=True,
        )
