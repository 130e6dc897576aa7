"""A record on its way from machine to machine, beside the same packed by Python."""

import struct
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pbonet import tbuf, xm
from pbonet.errors import ProtocolError, XmError
from pbonet.node.agent import link_ends
from pbonet.node.wire import Clock
from pbonet.tbuf import layout, places
from pbonet.tbuf.native import READER, WRITER, In, Out, parts

HEAD = struct.Struct("<4sHHQQqq")
SIX = np.dtype(("f8", (6,)))
HOUR = 3_600_000_000_000
SECOND = 1_000_000_000
MOST = (1 << 63) - 1


def pack(*numbers, text, data, version=1):
    """Pack counter, whose it is, time, age, description and bytes."""
    return HEAD.pack(b"pbTB", version, len(text), *numbers) + text + data


@pytest.fixture(autouse=True)
def home():
    xm.live_on("arm0", domain="d", subsystem="arm")
    yield
    xm.live_on("local")


def agents_end(kind, role, name, dtype=SIX):
    """Return an end as an agent takes it, and the array that it holds."""
    end = kind()
    kept = places.attach(places.name_to_read(name), dtype, role, end)
    raw = layout.room(kept)
    end.hold(raw, raw, raw)
    return end, raw


@pytest.fixture
def far():
    """The writing end of the other machine's agent, its array, and a reader there."""
    end, raw = agents_end(Out, WRITER, "vision:x")
    reader = tbuf.Reader("vision:x", SIX)
    yield end, raw, reader
    reader.close()
    places.leave(end)


def test_a_record_travels_as_python_packs_it(far):
    there, _, reader = far
    writer = tbuf.Writer("x", SIX)
    here, _ = agents_end(In, READER, "arm:x")
    assert here.message(0) is None
    writer.value[:] = range(6)
    writer.write()
    message = here.message(0)
    assert here.message(0) is None, "once"
    number, source, stamp, age, text, data = parts(message)
    assert (number, stamp, data) == (1, writer.time_ns, np.arange(6.0).tobytes())
    assert 0 <= age <= time.monotonic_ns() - stamp
    assert text == layout.describe(SIX)
    assert message == pack(number, source, stamp, age, text=text, data=data)
    assert there.take(message, stamp + SECOND, SECOND - age)
    assert reader.read()
    assert reader.value.tolist() == [0, 1, 2, 3, 4, 5]
    assert (reader.number, reader.stamp_ns) == (1, stamp)
    assert reader.time_ns == stamp + SECOND - age
    places.leave(here)
    writer.close()


@pytest.mark.parametrize("message", [b"", b"pbTB", b"x" * 100, b"pbTB" + bytes(35)])
def test_what_is_no_record_is_refused(far, message):
    with pytest.raises(ProtocolError, match="not a record"):
        parts(message)
    with pytest.raises(ProtocolError, match="not a record"):
        far[0].take(message, 0, None)


def good(stamp=0, age=0, **other):
    """Return a message with a record of six numbers, but for what is told."""
    fields = {"text": layout.describe(SIX), "data": bytes(48)} | other
    return pack(1, 2, stamp, age, **fields)


def test_records_of_another_version_are_refused(far):
    with pytest.raises(ProtocolError, match=r"another version .*got version 9"):
        far[0].take(good(version=9), 0, None)


@pytest.mark.parametrize("data", [b"", bytes(47), bytes(49)])
def test_records_of_another_length_are_refused(far, data):
    with pytest.raises(ProtocolError, match="cut short"):
        far[0].take(good(data=data), 0, None)


@pytest.mark.parametrize(
    ("now", "age", "stamp", "offset"),
    [
        (HOUR, -(1 << 63), 0, None),
        (-2, (1 << 63) - 1, 0, None),
        (0, 0, (1 << 63) - 1, 1),
    ],
)
def test_impossible_times_are_refused(far, now, age, stamp, offset):
    with pytest.raises(ProtocolError, match="time is impossible"):
        far[0].take(good(age=age, stamp=stamp), now, offset)


def test_other_words_are_not_taken_until_the_values_are_turned(far):
    there, raw, reader = far
    swapped = layout.describe(SIX.newbyteorder())
    message = good(text=swapped, data=np.arange(6.0).astype(">f8").tobytes())
    assert not there.take(message, HOUR, None)
    assert not reader.read()
    raw[...] = range(6)
    assert there.take(message, HOUR, None, turned=True)
    assert reader.read()
    assert reader.value.tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("apart", [0, HOUR, -HOUR])
def test_ages_stay_right_however_far_clocks_are_apart(far, apart):
    """Their clock is `apart` ahead; the record is 3 ms old, 2 of them on the way."""
    there, _, reader = far
    now, stamp, age = 10 * HOUR, 10 * HOUR - 3_000_000 + apart, 1_000_000

    def aged(offset, error=0):
        assert there.take(good(stamp=stamp, age=age), now, offset, error)
        assert reader.read()
        return now - reader.time_ns

    assert aged(-apart) == 3_000_000
    assert aged(-apart - 500_000) == 3_500_000
    younger = -apart + 9_000_000
    assert aged(younger, 7_000_000) == 1_000_000, "no younger than when it was sent"


@pytest.mark.parametrize("known", [(None,), (9_000_000, 6_999_999)])
def test_a_record_is_old_if_the_other_clock_is_unknown_or_not_as_measured(far, known):
    there, _, reader = far
    now, stamp = 10 * HOUR, 10 * HOUR - 3_000_000
    assert there.take(good(stamp=stamp, age=1_000_000), now, *known)
    assert reader.read()
    assert reader.time_ns == 1, "0 would mean that there is no time"


def test_an_agent_knows_no_age_without_the_clock_and_takes_nothing_of_a_stopped_one(
    monkeypatch,
):
    """After a cut a clock may be unknown: that is never taken as the time of here."""
    monkeypatch.setattr(link_ends.process_setup, "go_before_others", bool)
    declared = SimpleNamespace(undeclare=lambda: None)
    clock, refused = [None], [False]
    reader = tbuf.Reader("vision:y", SIX)
    receiver = link_ends.Receiver(
        SimpleNamespace(declare_subscriber=lambda *_: declared),
        places.name_to_read("vision:y"),
        "key",
        who="agent arm0 from eye0",
        clock=lambda: clock[0],
        refuses=lambda: refused[0],
        misfit=pytest.fail,
    )

    def come():
        """Let a record come, sent just now; return its time here, if it is taken."""
        message = good(stamp=time.monotonic_ns(), age=0)
        receiver._again = 0  # the clock is asked for at times only
        receiver._take(
            SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: message))
        )
        return reader.time_ns if reader.read() else None

    try:
        assert come() == 1
        clock[0] = Clock(0, 0)
        assert time.monotonic_ns() - come() < HOUR
        clock[0] = None
        assert come() == 1
        refused[0] = True
        assert come() is None
    finally:
        receiver.stop()
        reader.close()


@given(st.binary(max_size=200))
def test_no_bytes_do_harm(noise):
    end, _ = agents_end(Out, WRITER, "vision:noise")
    for message in (noise, good()[: len(noise)] + noise, b"pbTB\x01\x00" + noise):
        try:
            assert end.take(message, HOUR, 0) in {True, False}
        except ProtocolError:
            continue
    places.leave(end)


def test_a_closed_end_takes_and_sends_nothing():
    end, _ = agents_end(Out, WRITER, "vision:y")
    sender, _ = agents_end(In, READER, "vision:y")
    places.leave(end)
    places.leave(sender)
    with pytest.raises(XmError, match="closed"):
        end.take(good(), 0, None)
    with pytest.raises(XmError, match="closed"):
        sender.message(0)


def test_records_that_are_regular_and_then_are_not_all_come():
    """The sender awaits awake what it expects, and sleeps when that does not come."""
    writer = tbuf.Writer("z", ("i8", ()))
    end, _ = agents_end(In, READER, "arm:z", np.dtype(("i8", ())))
    got = []

    def take():
        while not got or got[-1] != 99:
            message = end.message(time.monotonic_ns() + 50_000_000)
            if message is not None:
                got.append(int.from_bytes(parts(message)[-1], "little"))

    taker = threading.Thread(target=take, daemon=True)
    taker.start()

    def write(number):
        writer.value[...] = number
        writer.write()
        deadline = time.monotonic() + 10
        while not got or got[-1] != number:
            assert time.monotonic() < deadline, f"{number} has not come"
            time.sleep(0.0002)

    for number in range(60):  # every millisecond, as near as that can be
        write(number)
        time.sleep(0.0008)
    time.sleep(0.1)
    for number in (60, 61, 99):
        write(number)
        time.sleep(0.02)
    taker.join(10)
    assert got == [*range(60), 60, 61, 99]
    places.leave(end)
    writer.close()
