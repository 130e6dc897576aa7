"""The live table: rows from one reading, order, filter and keys; no terminal."""

from __future__ import annotations

import io
import threading
import time
from types import SimpleNamespace

import pytest
from rich.console import Console
from test_explain import agent, rtpus, status, value

from pbonet.errors import StateError, UnreachableError
from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.operating import live_table, subsystem_reader
from pbonet.master.operating.live_table import watch
from pbonet.master.operating.subsystem_reader import SubsystemReader
from pbonet.master.operating.table_rows import COLUMNS, Reading, Row, all_rows, text_of
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


def test_an_explanation_is_scrolled(shown):
    view = TableView()
    shown(view, "enter")
    view.explained = "because ..."
    shown(view, "down", "pagedown", "up")
    assert view.first == 10
    shown(view, "escape", "down", "enter")
    assert view.first == 0


def test_a_narrow_screen_has_whole_columns(reading):
    every = all_rows(reading, Window())
    view = TableView()
    console = Console(width=60, height=24, file=io.StringIO())
    console.print(live_table._table(view, every, 20, console.width))
    lines = console.file.getvalue().splitlines()
    assert "columns do not fit" in lines[0]
    assert lines[1].split()[:4] == ["task", "rtpu", "machine", "state"]
    assert "\N{HORIZONTAL ELLIPSIS}" not in "".join(lines)


class Slow:
    """A subsystem's questions, of which the first takes until the second is asked."""

    def __init__(self, monkeypatch):
        self.begun, self.go_on = threading.Event(), threading.Event()
        monkeypatch.setattr(diagnosis, "ask", self.ask)
        monkeypatch.setattr(diagnosis, "explain", lambda _, asked: asked.name)

    def ask(self, *_):
        self.begun.set()
        assert self.go_on.wait(30)


def answered(reader, row):
    deadline = time.monotonic() + 30
    while reader.explained[0] is not row:
        assert time.monotonic() < deadline
        reader.news.wait(0.01)
    return reader.explained[1]


def test_an_explanation_belongs_to_its_row(monkeypatch):
    slow = Slow(monkeypatch)
    made = SimpleNamespace(open=lambda **_: None, detach=lambda: None)
    reader = SubsystemReader(lambda: made, 30.0)
    monkeypatch.setattr(reader, "_reading", lambda _: Reading())
    first, second = Row("task", "a", ()), Row("task", "b", ())
    reader.explain(first)
    reader.start()
    try:
        assert slow.begun.wait(30)
        reader.explain(second)
        assert reader.explained[0] is not second
        slow.go_on.set()
        assert answered(reader, second) == "b"
    finally:
        slow.go_on.set()
        reader.close()


def test_an_error_of_the_program_ends_the_table(monkeypatch, puma):
    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(SubsystemReader, "_unreached", broken)
    with pytest.raises(ZeroDivisionError):
        watch(
            puma,
            Place(domain="nowhere"),
            sort="",
            wanted="",
            every=None,
            count=1,
            as_data=True,
        )


def test_an_agent_that_is_away_is_looked_for_after_a_pause(monkeypatch):
    opened = []

    def away(**_):
        opened.append(time.monotonic())
        raise UnreachableError("no agent")

    made = SimpleNamespace(open=away, sbs=SimpleNamespace(rtpus=[]))
    monkeypatch.setattr(subsystem_reader, "RETRY", 30.0)
    monkeypatch.setattr(diagnosis, "unreached", lambda *_: None)
    monkeypatch.setattr(diagnosis, "explain", lambda _, asked: asked.name)
    reader = SubsystemReader(lambda: made, 30.0)
    first, second = Row("task", "a", ()), Row("task", "b", ())
    reader.start()
    try:
        reader.explain(first)
        answered(reader, first)
        reader.explain(second)
        answered(reader, second)
        deadline = time.monotonic() + 30
        while reader._due.is_set():
            assert time.monotonic() < deadline, "it asks again and again"
        assert len(opened) <= 5, "once for each question, and when one came meanwhile"
    finally:
        reader.close()


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
