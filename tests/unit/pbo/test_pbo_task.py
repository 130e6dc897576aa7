"""``self.task``: what a module sees of its task, and what it can say."""

import contextlib

import pytest

from pbonet import Signal, State, TaskContext, UserSignal
from pbonet.errors import MethodError
from pbonet.pbo import Answer, BoundedOutbox, Counted, TaskFailure


@pytest.fixture
def task():
    source = Counted(lambda: 5_000)
    return TaskContext("arm", rmod="law", freq=200.0, source=source)


def test_the_fields_of_the_thesis(task):
    assert (task.name, task.rmod, task.crit) == ("arm", "law", 0)
    task.source.crit = 7
    assert task.crit == 7
    assert (task.freq, task.period) == (200.0, 0.005)
    assert (task.state, task.nextstate) == (State.NOT_CREATED, State.OFF)
    assert (task.errmsg, task.errnum, task.nwarnings) == ("", 0, 0)
    assert (task.signals, task.sigmask, task.arg) == (0, 0, "")
    assert TaskContext("free").period == 0.0
    assert TaskContext("free").rmod == "free"


def test_time_comes_from_the_release_within_a_cycle_else_from_the_clock(task):
    assert task.now == 5_000
    task.source.release = 4_000
    task.source.cyclecount = 3
    assert (task.now, task.cyclecount) == (4_000, 3)


def test_signals_go_to_the_outbox(task):
    task.signal(Signal.FINISH, "there")
    (notice,) = task.outbox.drain()
    assert (notice.bits, notice.text, notice.now) == (Signal.FINISH, "there", 5_000)
    assert task.signals == Signal.FINISH
    assert not task.off_requested


def test_the_signal_off_asks_to_be_turned_off(task):
    task.signal(Signal.OFF)
    assert task.off_requested


def test_masked_signals_are_noted_but_not_sent():
    class Masked(TaskContext):
        sigmask = Signal.FINISH | Signal.WARNING

    task = Masked()
    task.signal(Signal.FINISH)
    task.warn("hot")
    assert task.signals == Signal.FINISH | Signal.WARNING
    assert task.outbox.drain() == []
    task.signal(Signal.FINISH | Signal.SHUTDOWN)
    assert [notice.bits for notice in task.outbox.drain()] == [Signal.SHUTDOWN]


def test_warnings_are_counted_and_sent(task):
    task.warn("motor is warm", 12)
    task.warn("motor is hot", 13)
    assert (task.nwarnings, task.errmsg, task.errnum) == (2, "motor is hot", 13)
    notices = task.outbox.drain()
    assert [(n.bits, n.code) for n in notices] == [(Signal.WARNING, 12), (8, 13)]


def test_a_full_outbox_drops_the_oldest_and_counts():
    outbox = BoundedOutbox(2)
    task = TaskContext(outbox=outbox)
    for text in "abc":
        task.warn(text)
    assert outbox.dropped == 1
    assert [notice.text for notice in outbox.drain()] == ["b", "c"]
    assert outbox.drain() == []


def test_user_signals_stand_behind_the_predefined_ones():
    assert UserSignal(0, "first") == 1 << 7
    assert UserSignal(24, "last") == 1 << 31
    for wrong in (-1, 25):
        with pytest.raises(ValueError, match="user signals go from 0 to 24"):
            UserSignal(wrong, "none")


def test_fail_unwinds_where_nobody_can_be_asked(task):
    with pytest.raises(TaskFailure) as caught:
        task.fail("no device", 3)
    assert (task.errmsg, task.errnum) == ("no device", 3)
    assert caught.value.answer is None


def test_fail_comes_back_when_error_says_continue(task):
    seen = []
    task.on_fail = lambda error: seen.append(error) or Answer.CONTINUE
    task.fail("slip")
    assert isinstance(seen[0], MethodError)
    assert seen[0].what == "slip"


def test_fail_unwinds_with_the_answer_and_past_except_exception(task):
    task.on_fail = lambda _: Answer.OFF

    def careless():
        with contextlib.suppress(Exception):
            task.fail("slip")

    with pytest.raises(TaskFailure) as caught:
        careless()
    assert caught.value.answer is Answer.OFF


def test_reset_forgets_what_was_counted(task):
    task.warn("hot")
    task.signal(Signal.OFF)
    task.reset()
    assert (task.nwarnings, task.signals, task.errmsg, task.errnum) == (0, 0, "", 0)
    assert not task.off_requested
