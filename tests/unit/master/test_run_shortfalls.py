"""What a run lacks, though nothing failed: its last line and its exit status."""

import queue
import signal
import threading
from types import SimpleNamespace

import msgspec
import pytest
from watching import wait_for

from pbonet.errors import NodeError
from pbonet.master.console import summary
from pbonet.master.console.run_end import (
    MOST_READ,
    Interrupts,
    Outcome,
    Shortfall,
    Standstills,
    Status,
    unrecorded,
)
from pbonet.xm.net import messages as m


class FakeLog:
    """A log as `unrecorded` reads it."""

    complete = True

    parts = (SimpleNamespace(about=SimpleNamespace(rtpu="c0")),)

    def __init__(self, lost=(), damage=(), size=0) -> None:
        self._lost, self._damage, self.size = dict(lost), damage, size
        self.read = False

    def lost(self):
        self.read = True
        return self._lost

    def check(self):
        self.read = True
        return self._damage


def rtpu(stalls, stalled, missed=0):
    counts = dict.fromkeys(("crit", "cycle", "warn", "tid"), 0) | {"miss": missed}
    figures = ("ref_f", "mez_f", "mez_t", "ptime", "tot_c", "tick", "min_c", "max_c")
    rest = counts | dict.fromkeys((*figures, "last_c"), 0.0)
    task = m.TaskStatus(rmod="a", task="a", rtpu="c0", S="P", state="ON", **rest)
    return m.RtpuStatus(
        rtpu="c0",
        backend="fifo",
        scheduler="MUF",
        tasks=[task],
        stalls=stalls,
        stalled=stalled,
    )


def outcome(*shortfalls, strict=True, faults=()):
    return Outcome(
        job="j",
        seconds=1.0,
        tasks=[],
        reason="1 s are over",
        faults=list(faults),
        shortfalls=list(shortfalls),
        strict=strict,
    )


def test_standstills_of_this_run_are_told_if_cycles_were_lost():
    found = Standstills()
    found.update([rtpu(5, 0.5)])  # before this run
    found.update([rtpu(7, 0.75, missed=9)])
    last = summary.summarize([rtpu(7, 0.75, missed=9)])
    assert found.text(last) == (
        "the machine of c0 stood still 2 times, 0.25 s in all; its tasks missed 9 "
        "releases in this run"
    )
    assert not found.text(summary.summarize([rtpu(7, 0.75)])), "nothing was lost"
    same = Standstills()
    same.update([rtpu(5, 0.5, missed=9)])
    assert not same.text(last)


def test_what_is_not_in_the_log_is_told():
    assert not unrecorded(FakeLog(), ["c0"], {"c0"})
    assert not unrecorded(None, ["c0"], {"c0"}), "its log is on another machine"
    cut = FakeLog({"a": 3}, ["part"])
    cut.complete = False
    assert unrecorded(cut, ["c0", "c1"], {"c0"}) == (
        "not recorded: nothing of c1, 3 cycles of a, 1 damaged parts of the log, the "
        "end of the log"
    )


def test_a_long_log_is_not_read_at_the_end():
    """Reading that of a day takes minutes; what was lost stands in the status."""
    log, lost = FakeLog(size=MOST_READ + 1), {"c0": 3, "c1": 0}
    assert unrecorded(log, ["c0"], {"c0"}, lost) == "not recorded: 3 cycles of c0"
    assert not log.read
    log.complete = False
    assert "the end of the log" in unrecorded(log, ["c0"], {"c0"})


def test_what_recorders_elsewhere_have_lost_stands_in_the_status():
    lost = {"c0": 2, "c1": 5}
    planned = ["c0", "c1"]
    said = "not recorded: 4 cycles of a, 5 cycles of c1"
    assert unrecorded(FakeLog({"a": 4}), planned, {*planned}, lost) == said
    said = "not recorded: 2 cycles of c0, 5 cycles of c1"
    assert unrecorded(None, planned, {*planned}, lost) == said


@pytest.mark.parametrize("status", list(Status))
def test_each_shortfall_has_its_own_status_in_a_strict_run(status):
    one = Shortfall(status, "so it was")
    assert outcome(one).status == int(status)
    assert outcome(one).last_line() == (
        f"ERROR> exit status {int(status)} (--strict): so it was"
    )
    assert outcome(one, strict=False).status == 0
    assert outcome(one, strict=False).last_line() == "WARNING> so it was"
    assert outcome(one, faults=["a fault"]).status == 1
    assert msgspec.json.decode(msgspec.json.encode(outcome(one)))["shortfalls"]


@pytest.mark.parametrize(
    ("only_last", "found", "text"),
    [
        (False, (), "every cycle is in runs/j"),
        (True, (), "what came before each error is in runs/j"),
        (
            True,
            [Shortfall(Status.UNRECORDED, "lost")],
            "what was recorded is in runs/j",
        ),
    ],
)
def test_the_line_of_the_log_says_what_it_has(only_last, found, text):
    ended = outcome(*found)
    ended.log, ended.recording = "runs/j", SimpleNamespace(only_last=only_last)
    assert ended.log_line() == text


def test_of_several_shortfalls_the_smallest_status_counts_and_all_are_told():
    found = outcome(
        Shortfall(Status.STOPPED, "stopped"), Shortfall(Status.UNRECORDED, "lost")
    )
    assert found.status == 3
    assert found.last_line() == "ERROR> exit status 3 (--strict): stopped; lost"
    assert (outcome().status, outcome().last_line()) == (0, "")


def test_a_signal_ends_a_wait_that_has_just_begun():
    """It comes while the main thread holds the lock of the event it waits for."""
    interrupts = Interrupts()
    with interrupts.wished._cond:
        interrupts.take(signal.SIGINT, None)
    assert interrupts.wished.wait(60)


def test_each_interrupt_of_a_run_says_what_it_does():
    """What fails in a stop is shown by the end of the run."""
    told: queue.SimpleQueue[str] = queue.SimpleQueue()
    interrupts = Interrupts(ends="it ends in order", say=told.put)
    stops = []

    def stop():
        stops.append(1)
        raise NodeError("no answer", where="arm1")

    interrupts.force = stop
    interrupts.awaited = lambda: "the off of a on arm1"
    texts = []
    for _ in range(3):
        interrupts.take(signal.SIGINT, None)
        texts.append(told.get(timeout=60))
    assert texts == [
        "interrupted: it ends in order",
        "interrupted again: everything is stopped at once",
        "interrupted again: the end is under way; waits for the off of a on arm1",
    ]
    wait_for(lambda: stops == [1], "one stop")


def test_a_second_interrupt_stops_everything_also_when_its_line_cannot_be_shown():
    """`| tee` is ended by the same Ctrl-C."""

    def closed(_text):
        raise BrokenPipeError

    interrupts = Interrupts(say=closed)
    stopped = threading.Event()
    interrupts.force = stopped.set
    for _ in range(2):
        interrupts.take(signal.SIGINT, None)
    assert stopped.wait(60)


@pytest.mark.parametrize("nohup", [False, True])
def test_a_closed_terminal_ends_a_run_in_order_but_under_nohup(nohup):
    interrupts = Interrupts()
    handler = signal.SIG_IGN if nohup else signal.SIG_DFL
    before = signal.signal(signal.SIGHUP, handler)
    try:
        with interrupts.caught():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is handler
    finally:
        signal.signal(signal.SIGHUP, before)
    assert interrupts.count == (not nohup)
