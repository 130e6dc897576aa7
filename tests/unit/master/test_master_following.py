"""Each event is handed out once, whatever the RTPU process goes through."""

import time
from types import SimpleNamespace

import msgspec
import pytest

from pbonet.errors import NoAnswerError, Severity, StateError
from pbonet.master.console.follow_events import Follower
from pbonet.master.subsystem.event_filter import EventFilter, since
from pbonet.node.wire.event_log import KEPT, EventLog
from pbonet.xm.net import messages as m


class Rtpu:
    """An RTPU process that can be restarted, behind what a follower asks."""

    names = ("arm0",)

    def __init__(self):
        self.now = 0
        self.silent = False
        self.restart()

    def restart(self):
        self.log = EventLog("arm0", clock_ns=self.clock, wall=lambda: float(self.now))

    def clock(self):
        self.now += 1
        return self.now

    def each(self, make, _, *, rtpus):
        (rtpu,) = rtpus
        if self.silent:
            return {}, [NoAnswerError("no answer", where=rtpu)]
        return {rtpu: self.log.since(make(rtpu).since, limit=50)}, []

    def tell(self, *texts, severity=Severity.INFO, code="X", **more):
        for text in texts:
            self.log.add(severity, code, text, **more)


@pytest.fixture
def rtpu():
    return Rtpu()


def follower(rtpu, **wanted):
    return Follower(SimpleNamespace(name="s", clients=rtpu), EventFilter(**wanted))


def texts(found):
    return [event.text for event in found]


def test_a_code_that_no_event_has_is_doubted_with_the_first_look(rtpu):
    rtpu.tell("a", code="NEWS")
    rtpu.tell("b", subsystem="other", code="OTHER_NEWS")
    follow = follower(rtpu, code="NEWSS")
    follow.take()
    assert follow.doubt == "no event has the code NEWSS; did you mean NEWS?"
    known = follower(rtpu, code="OTHER_NEWS")
    known.take()
    assert known.doubt == ""


def test_each_event_comes_once(rtpu):
    follow = follower(rtpu)
    assert follow.take() == []
    rtpu.tell("a", "b")
    assert texts(follow.take()) == ["a", "b"]
    assert follow.take() == []
    rtpu.tell("c")
    assert texts(follow.take()) == ["c"]


def test_long_lists_are_asked_for_in_pieces(rtpu):
    follow = follower(rtpu)
    rtpu.tell(*map(str, range(120)))
    assert texts(follow.take()) == list(map(str, range(120)))
    rtpu.tell(*map(str, range(120)))
    assert texts(follow.take()) == list(map(str, range(120)))
    assert follow.left_out == 0


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_process_begun_anew_is_noticed(rtpu, count):
    follow = follower(rtpu)
    rtpu.tell("a", "b", "c")
    follow.take()
    rtpu.restart()
    new = [f"new {n}" for n in range(count)]
    rtpu.tell(*new)
    assert texts(follow.take()) == new
    rtpu.tell("more")
    assert texts(follow.take()) == ["more"]


def test_what_was_forgotten_is_counted(rtpu):
    follow = follower(rtpu)
    rtpu.tell("a")
    follow.take()
    rtpu.tell(*["b"] * (KEPT + 7))
    assert len(follow.take()) == KEPT
    assert follow.left_out == 7


def test_silence_is_told_and_nothing_missed(rtpu):
    follow = follower(rtpu)
    rtpu.tell("a")
    follow.take()
    rtpu.silent = True
    rtpu.tell("b")
    assert follow.take() == []
    assert follow.complaints() == {"arm0": "arm0: no answer"}
    rtpu.silent = False
    assert texts(follow.take()) == ["b"]
    assert follow.complaints() == {}


def test_choice(rtpu):
    follow = follower(rtpu, least=Severity.WARNING, task="t")
    rtpu.tell("info", subsystem="s", task="t")
    rtpu.tell("warning", severity=Severity.WARNING, subsystem="s", task="t")
    rtpu.tell("other task", severity=Severity.ERROR, subsystem="s", task="u")
    rtpu.tell("other subsystem", severity=Severity.ERROR, subsystem="z", task="t")
    assert texts(follow.take()) == ["warning"]
    assert EventFilter.of({"severity": "Error"}).least is Severity.ERROR
    with pytest.raises(StateError, match=r"no severity worse .*debug info warning"):
        EventFilter.of({"severity": "worse"})


@pytest.mark.parametrize(
    ("word", "seconds"), [("90s", 90), ("5m", 300), ("1.5h", 5400), ("2d", 172800)]
)
def test_since_how_long_ago(word, seconds):
    now = time.time()
    number, after = since(word)
    assert number == 0
    assert now - seconds <= after <= time.time() - seconds
    wanted = EventFilter.of({"since": word, "severity": "warning"})
    kinds = {"n": 1, "time": 0, "code": "C", "rtpu": "r", "text": "t"}
    young = m.Event(**kinds, wall=now, severity=30)
    assert wanted(young)
    assert not wanted(msgspec.structs.replace(young, wall=now - seconds - 1))
    assert not wanted(msgspec.structs.replace(young, severity=20))


def test_since_a_number_or_nonsense():
    assert since(7) == since("7") == (7, 0.0)
    with pytest.raises(StateError, match="this is neither a number nor a time"):
        since("yesterday")
