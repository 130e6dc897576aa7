"""What a task tells of errors on its way to an event: number, line, and counts."""

from __future__ import annotations

import socket
import threading
from collections import Counter

import msgspec
import numpy as np
import pytest

from pbonet.errors import MethodError, Severity
from pbonet.master.console import render
from pbonet.master.subsystem.event_filter import EventFilter
from pbonet.node.rtpu.task_handle import crash_place
from pbonet.node.task.task_channel import RtpuChannel
from pbonet.node.wire import rtpu_messages
from pbonet.node.wire.event_log import EventLog, by_task
from pbonet.pbo import Notice, State, place_of

PLACE = "/lib/arm.py:31 in cycle"
HANDLED = Notice(0, "too hot: jump", 7, 5, 0, handled=True, place=PLACE)


@pytest.fixture
def ends():
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    far.settimeout(0)
    with near, far:
        yield RtpuChannel(near), far


def heard(far):
    """Return the messages that wait."""
    decoder = msgspec.msgpack.Decoder(rtpu_messages.FromTask)
    found = []
    while True:
        try:
            found.append(decoder.decode(far.recv(2 * rtpu_messages.LARGEST_PACKET)))
        except BlockingIOError:
            return found


def test_what_a_handler_put_right_is_a_warning_with_number_and_line(ends):
    to_rtpu, far = ends
    to_rtpu.put(HANDLED)
    (told,) = heard(far)
    assert (told.code, told.severity) == ("HANDLED", Severity.WARNING)
    assert (told.text, told.cycle) == ("too hot: jump", 5)
    assert (told.errnum, told.place, told.state) == (7, PLACE, "")


def test_a_signal_to_another_task_waits_for_room_and_is_not_lost(ends):
    to_rtpu, far = ends
    while not to_rtpu._lost:
        to_rtpu.put(HANDLED)
    to_rtpu.put(Notice(0, "off to b", 0, 5, 0, order=("b", "off")))
    heard(far)
    assert to_rtpu.pay()
    assert [one.order for one in heard(far)] == [("b", "off")]


def test_an_error_is_told_with_number_and_line(ends):
    to_rtpu, far = ends
    error = MethodError("too hot", where="servo.cycle")
    error.number, error.place = 7, PLACE
    to_rtpu.notice(Severity.ERROR, "METHOD", str(error), state=State.ERROR, error=error)
    to_rtpu.notice(Severity.INFO, "STATE", "turned off")
    told, other = heard(far)
    assert (told.errnum, told.place) == (7, PLACE)
    assert (other.errnum, other.place) == (0, "")


@pytest.mark.parametrize("last", ["notice", "answer"])
def test_in_a_flood_every_notice_is_told_or_counted(ends, last):
    to_rtpu, far = ends
    for _ in range(3000):
        to_rtpu.put(HANDLED)
    first = heard(far)
    assert 0 < len(first) < 3000
    if last == "notice":
        to_rtpu.put(HANDLED)
    else:
        to_rtpu.say(rtpu_messages.Done(n=1, state=State.OFF))
    (end,) = heard(far)
    assert len(first) + end.lost["HANDLED"] == 3000
    to_rtpu.say(rtpu_messages.Done(n=2, state=State.OFF))
    assert heard(far)[0].lost == {}


def test_news_of_the_state_wait_for_room_and_come_in_order(ends):
    to_rtpu, far = ends
    for _ in range(3000):
        to_rtpu.put(HANDLED)
    to_rtpu.notice(Severity.ERROR, "METHOD", "broken", state=State.ERROR)
    to_rtpu.put(HANDLED)
    assert to_rtpu.owing == [to_rtpu.sock]
    to_rtpu.pay()  # there is no room yet
    chatter = heard(far)
    to_rtpu.pay()
    assert to_rtpu.owing == []
    to_rtpu.notice(Severity.INFO, "STATE", "clear", state=State.OFF)
    news, clear = heard(far)
    assert (news.state, clear.state) == ("ERROR", "OFF")
    assert len(chatter) + news.lost["HANDLED"] + clear.lost["HANDLED"] == 3001


def test_an_answer_comes_behind_the_news_that_are_owed(ends):
    to_rtpu, far = ends
    while not to_rtpu.owing:
        to_rtpu.notice(Severity.ERROR, "METHOD", "broken", state=State.ERROR)
    answer = threading.Thread(
        target=to_rtpu.say, args=[rtpu_messages.Done(n=1, state="OFF")]
    )
    answer.start()
    far.settimeout(30.0)
    while not isinstance(told := heard_next(far), rtpu_messages.Done):
        assert told.state == "ERROR"
    answer.join()
    assert to_rtpu.owing == []


def heard_next(far):
    data = far.recv(2 * rtpu_messages.LARGEST_PACKET)
    return msgspec.msgpack.decode(data, type=rtpu_messages.FromTask)


def test_a_text_of_any_length_is_told(ends):
    to_rtpu, far = ends
    error = MethodError("begin " + "\u20ac" * 250_000 + " end", where="servo.cycle")
    error.number, error.place = 7, PLACE
    to_rtpu.notice(Severity.ERROR, "METHOD", str(error), state=State.ERROR, error=error)
    (told,) = heard(far)
    assert (told.code, told.state, told.lost) == ("METHOD", "ERROR", {})
    assert (told.errnum, told.place) == (7, PLACE)
    for text in (told.text, told.error["what"]):
        assert "begin" in text
        assert "characters left out" in text
        assert text.endswith("end")


UNREADABLE = "/x/" + b"\xff".decode(errors="surrogateescape")


def test_a_text_that_is_no_unicode_is_told_with_escapes(ends):
    to_rtpu, far = ends
    error = MethodError(UNREADABLE, where="servo.cycle")
    to_rtpu.notice(Severity.ERROR, "METHOD", str(error), state=State.ERROR, error=error)
    to_rtpu.say(rtpu_messages.Done(n=1, state="OFF", error=error.to_wire()))
    for told in heard(far):
        assert told.error["what"] == "/x/\\udcff"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (np.float64(1.5), 1.5),
        (np.int64(3), 3),
        (np.bool_(True), True),
        ((1, np.zeros((2, 2))), [1, [[0.0, 0.0], [0.0, 0.0]]]),
    ],
)
def test_numbers_of_numpy_are_told_as_python_s(ends, given, told):
    to_rtpu, far = ends
    to_rtpu.say(rtpu_messages.Done(n=1, state="ON", result=given))
    assert heard(far)[0].result == told


@pytest.mark.parametrize("given", [1 + 2j, np.complex128(1j), 10**30, object()])
def test_what_cannot_be_told_is_answered_with_an_error(ends, given):
    to_rtpu, far = ends
    to_rtpu.say(rtpu_messages.Done(n=1, state="ON", result=given))
    (done,) = heard(far)
    assert (done.n, done.state, done.result) == (1, "ON", None)
    assert done.error["what"] == "the task's answer cannot be sent"


def test_counts_that_come_with_a_message_are_added():
    events = EventLog("arm0")
    events.add(Severity.WARNING, "HANDLED", "x", subsystem="s", task="t")
    events.count("HANDLED", 40, subsystem="s", task="t")
    assert Counter(by_task(events.counts(), "s")["t"]) == {"HANDLED": 41}


def event(**more):
    given = {"errnum": 7, "place": PLACE, "cycle": 5, "task": "servo", **more}
    return EventLog("arm0").add(Severity.ERROR, "METHOD", "too hot", **given)


def test_a_line_of_code_that_is_known_is_shown():
    assert render.event(event()).endswith(
        f"ERROR   arm0/servo METHOD cycle=5 errnum=7 too hot ({PLACE})"
    )
    assert render.event(event(place="")).endswith("too hot")


def test_events_are_chosen_by_the_module_s_number():
    assert EventFilter.of({"code": "7"})(event())
    assert EventFilter.of({"code": "METHOD"})(event())
    assert not EventFilter.of({"code": "8"})(event())


def test_the_line_is_the_module_s_not_the_native_loop_s():
    """In a task the outermost frame is one of Cython, with a path of its own."""
    loop = compile("cycle()", "pbonet/node/rt/_rt.pyx", "exec")
    law = compile("def cycle():\n    return 1 / 0", "/lib/arm.py", "exec")
    names = {}
    exec(law, names)  # noqa: S102 - the only way to a file of that name
    with pytest.raises(ZeroDivisionError) as caught:
        exec(loop, names)  # noqa: S102
    error = caught.value.with_traceback(caught.tb.tb_next)  # without this test's line
    assert place_of(error) == "/lib/arm.py:2 in cycle"


def test_the_line_of_a_crash():
    trace = (
        "Fatal Python error: Segmentation fault\n\nCurrent thread 0x1 (most recent "
        'call first):\n  File "/lib/arm.py", line 31 in cycle\n  File "/x.py", line 2'
        " in live"
    )
    assert crash_place(trace) == PLACE
    assert crash_place("killed") == ""
