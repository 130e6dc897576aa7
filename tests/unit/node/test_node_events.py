"""Events are numbered and kept; lines of output are bounded."""

import os

import pytest
from hypothesis import given, strategies as st

from pbonet.errors import Severity
from pbonet.node.task.task_output import LONGEST_LINE, DroppingWriter, Lines
from pbonet.node.wire.event_log import KEPT, LONGEST_TEXT, EventLog, LineBudget, by_task

SECOND = 1_000_000_000


def log():
    return EventLog("arm0", clock_ns=lambda: 7, wall=lambda: 1.5)


def test_events_are_numbered_and_published():
    events, heard = log(), []
    events.publish = heard.append
    first = events.add(Severity.INFO, "STATE", "on", subsystem="s", task="t", cycle=3)
    second = events.add(Severity.ERROR, "METHOD", "no", bits=4)
    assert (first.n, second.n, events.next) == (1, 2, 3)
    assert (first.time, first.wall, first.rtpu) == (7, 1.5, "arm0")
    assert (first.subsystem, first.task, first.cycle) == ("s", "t", 3)
    assert (second.severity, second.bits) == (40, 4)
    assert heard == events.since(0) == [first, second]


def test_since():
    events = log()
    assert events.since(0) == []
    for i in range(5):
        events.add(Severity.INFO, "X", str(i))
    assert [e.text for e in events.since(3)] == ["2", "3", "4"]
    assert [e.text for e in events.since(2, limit=2)] == ["1", "2"]
    assert events.since(6) == []


def test_old_events_go_and_numbers_stay():
    events = log()
    for i in range(KEPT + 10):
        events.add(Severity.INFO, "X", str(i))
    kept = events.since(0)
    assert len(kept) == KEPT
    assert kept[0].n == 11
    assert events.since(KEPT + 10)[0].n == KEPT + 10


def test_counts_by_task_and_code_with_what_is_held_back():
    events = log()
    for _ in range(KEPT + 1):
        events.add(Severity.INFO, "STATE", "on", subsystem="s", task="t")
    events.count("WARNING", subsystem="s", task="t")
    events.add(Severity.INFO, "CLAIM", "s", subsystem="s")
    events.add(Severity.INFO, "ENDING", "the process")
    events.add(Severity.INFO, "STATE", "on", subsystem="other", task="t")
    assert by_task(events.counts(), "s") == {
        "t": {"STATE": KEPT + 1, "WARNING": 1},
        "": {"CLAIM": 1, "ENDING": 1},
    }
    assert by_task(events.counts())["t"]["STATE"] == KEPT + 2
    events.forget("s")
    assert by_task(events.counts(), "s") == {"": {"ENDING": 1}}


def test_long_texts_are_cut():
    text = log().add(Severity.INFO, "X", "a" * (LONGEST_TEXT + 5)).text
    assert text.endswith("a ... (5 more)")


def test_budget_passes_a_burst_and_then_a_rate():
    budget = LineBudget(rate=10.0, burst=5.0)
    assert [budget.take(SECOND) for _ in range(7)] == [True] * 5 + [False] * 2
    assert budget.take_suppressed() == 2
    assert budget.take_suppressed() == 0
    assert budget.take(SECOND + SECOND // 10)
    assert not budget.take(SECOND + SECOND // 10)


@given(st.lists(st.integers(0, SECOND), max_size=200))
def test_budget_is_never_exceeded(steps):
    budget = LineBudget(rate=10.0, burst=5.0)
    now, passed = 0, 0
    for step in steps:
        now += step
        passed += budget.take(now)
        assert passed <= 5.0 + 10.0 * now * 1e-9 + 1e-6


def lines(*pieces, budget=None):
    heard = []
    cut = Lines(heard.append, lambda: 0, budget)
    for piece in pieces:
        cut.feed(piece)
    cut.close()
    return heard


def test_lines_are_put_together():
    assert lines(b"one\ntw", b"o\n\r\nthr", b"ee") == ["one", "two", "", "three"]


def test_bytes_that_are_no_text():
    assert lines(b"\xff\xfe\n") == ["\\xff\\xfe"]


def test_endless_lines_are_cut():
    (text,) = lines(b"a" * (5 * LONGEST_LINE))
    assert text == "a" * LONGEST_LINE + f" ... ({4 * LONGEST_LINE} more)"


@pytest.mark.parametrize("parts", [[b"\n"], [b"", b"\n"], [b"\nnext\n"], [b"b\n"]])
def test_the_end_of_a_line_that_was_cut_is_no_empty_line(parts):
    first, *more = lines(b"a" * (5 * LONGEST_LINE), *parts)
    assert first.endswith("more)")
    assert more == [one for one in (b"".join(parts).decode().split("\n")) if one]


def test_an_empty_line_behind_one_that_was_cut_is_there():
    assert lines(b"a" * (5 * LONGEST_LINE), b"\n", b"\nb\n")[1:] == ["", "b"]


def test_what_is_printed_without_an_end_is_one_line():
    read, write = os.pipe()
    try:
        os.set_blocking(write, False)
        print("x" * (3 * LONGEST_LINE), file=DroppingWriter(write))
        assert lines(os.read(read, 1 << 16)) == [
            "x" * LONGEST_LINE + f" ... ({2 * LONGEST_LINE} more)"
        ]
    finally:
        os.close(read)
        os.close(write)


def test_lines_held_back_are_counted():
    heard = lines(b"1\n2\n3\n4\n", budget=LineBudget(rate=0.0, burst=2.0))
    assert heard == ["1", "2", "[2 lines held back: printed too fast]"]


def test_writer_sends_whole_lines_and_never_waits():
    read, write = os.pipe()
    os.set_blocking(write, False)
    writer = DroppingWriter(write)
    try:
        assert writer.writable()
        assert writer.fileno() == write
        assert writer.write("one\ntw") == 6
        assert os.read(read, 100) == b"one\n"
        writer.write("o\n")
        assert os.read(read, 100) == b"two\n"
        writer.write("rest")
        writer.flush()
        writer.flush()
        assert os.read(read, 100) == b"rest"
        for _ in range(100):
            writer.write("x" * 9999 + "\n")  # more than any pipe holds
        while len(os.read(read, 1 << 20)) == 1 << 16:
            pass
        writer.write("after\n")
        assert os.read(read, 100).startswith(b"[")
        os.close(read)
        read = -1
        writer.write("nobody hears this\n")
    finally:
        os.close(write)
        if read >= 0:
            os.close(read)
