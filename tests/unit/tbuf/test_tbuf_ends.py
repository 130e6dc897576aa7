"""Both ends of a link in one process: records, counters, times, layouts, places."""

import os
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given, strategies as st
from watching import wait_for

from pbonet import tbuf, xm
from pbonet.errors import (
    XmDamagedError,
    XmDestroyedError,
    XmError,
    XmLayoutError,
    XmMissingError,
    XmNameError,
    XmTakenError,
)
from pbonet.tbuf import layout, places
from pbonet.tbuf._tbuf import Buffer

SIX = np.dtype(("f8", (6,)))
POSE = np.dtype([("x", "f8", (3,)), ("valid", "?"), ("id", "i4")])
SECOND = 1_000_000_000


def repr_short(text):
    return repr(text[:12])


@pytest.fixture(autouse=True)
def home():
    xm.live_on("arm0", domain="d", subsystem="arm")
    yield
    xm.live_on("local")


@pytest.fixture
def link():
    """A writer and a reader of one link."""
    with tbuf.Writer("x", SIX) as writer, tbuf.Reader("arm:x") as reader:
        yield writer, reader


def test_the_newest_record_is_read_once(link):
    writer, reader = link
    assert not reader.read()
    assert reader.age_ns() is None
    for n in range(1, 6):
        writer.value[:] = n
        writer.write()
    assert reader.read()
    assert reader.value.tolist() == [5.0] * 6
    assert (reader.number, writer.number) == (5, 5)
    assert not reader.read(), "there is nothing new"
    assert reader.value.tolist() == [5.0] * 6, "and the old one stands"


def test_what_was_not_read_is_counted(link):
    writer, reader = link
    writer.write()
    reader.read()
    assert reader.lost == 0
    for _ in range(4):
        writer.write()
    reader.read()
    assert reader.lost == 3
    writer.write()
    reader.read()
    assert (reader.lost, reader.number) == (3, 6)


def test_time_is_stamped_by_clock_or_by_the_writer(link):
    writer, reader = link
    before = time.monotonic_ns()
    writer.write()
    after = time.monotonic_ns()
    reader.read()
    assert before <= reader.time_ns <= after
    assert reader.stamp_ns == reader.time_ns
    writer.write(before + 7)
    reader.read()
    assert reader.time_ns == before + 7
    assert reader.age_ns(before + 10) == 3
    assert reader.age_ns() >= after - before - 7


@given(writes=st.lists(st.booleans(), max_size=60))
def test_a_model_in_step(writes):
    """Whatever the order of writes and reads, a plain variable does the same."""
    head, taken, lost, number = None, 0, 0, 0
    with tbuf.Writer("model", "i8") as writer, tbuf.Reader("model") as reader:
        for is_write in writes:
            if is_write:
                number += 1
                writer.value[...] = head = number * 10
                writer.write()
                continue
            assert reader.read() is (number > taken)
            if number > taken:
                lost += number - taken - 1 if taken else 0
                taken = number
                assert reader.value == head
            assert (reader.number, reader.lost) == (taken, lost)


def test_records_have_fields_of_many_types():
    with tbuf.Writer("pose", POSE) as writer, tbuf.Reader("pose", POSE) as reader:
        writer.value["x"] = 1, 2, 3
        writer.value["valid"] = True
        writer.value["id"] = -7
        writer.write()
        assert reader.read()
        assert reader.value["x"].tolist() == [1.0, 2.0, 3.0]
        assert (reader.value["valid"], reader.value["id"]) == (True, -7)
        assert reader.value.dtype == POSE


def test_a_reader_takes_the_layout_that_the_writer_made():
    with tbuf.Writer("pose", POSE), tbuf.Reader("arm0:pose", POSE):
        pass
    with tbuf.Writer("pose", POSE), tbuf.Reader("pose") as reader:
        assert reader.value.dtype == POSE


@pytest.mark.parametrize(("mine", "theirs"), [("<", ">"), (">", "<")])
def test_the_other_byte_order_is_turned_round(mine, theirs):
    fields = [("x", "f8", (3,)), ("n", "u2"), ("in", [("k", "i4")])]
    written = np.dtype(fields).newbyteorder(mine)
    wanted = np.dtype(fields).newbyteorder(theirs)
    with tbuf.Writer("s", written) as writer, tbuf.Reader("s", wanted) as reader:
        writer.value[...] = (1.5, -2.0, 3.0), 513, (-70000,)
        writer.write()
        assert reader.read()
        assert reader.value.dtype == wanted
        assert reader.value["x"].tolist() == [1.5, -2.0, 3.0]
        assert reader.value["n"] == 513
        assert reader.value["in"]["k"] == -70000
    with tbuf.Reader("s", wanted) as reader, tbuf.Writer("s", written) as writer:
        writer.value["n"] = 258
        writer.write()
        assert reader.read()
        assert reader.value["n"] == 258, "also where the reader made the buffer"


def test_a_writer_may_send_from_an_array_of_its_own():
    data = np.arange(6.0)
    with tbuf.Writer("x", SIX, data=data) as writer, tbuf.Reader("x") as reader:
        data[3] = -1
        writer.write()
        reader.read()
        assert reader.value.tolist() == [0, 1, 2, -1, 4, 5]
    with pytest.raises(ValueError, match="does not fit"):
        tbuf.Writer("x", SIX, data=np.zeros(12)[::2])
    assert tbuf.Writer("x", SIX).close() is None, "a refusal keeps nothing"


def test_what_was_read_cannot_be_changed(link):
    with pytest.raises(ValueError, match="read-only"):
        link[1].value[0] = 1


def test_an_end_is_freed_without_its_methods(monkeypatch):
    """At the end of a process they may be gone before it."""
    said = []
    monkeypatch.setattr(sys, "unraisablehook", said.append)

    class Late(Buffer):
        unmap = None

    Late()
    assert not said


def test_one_writer_and_one_reader(link, monkeypatch):
    monkeypatch.setattr(places, "PATIENCE", 0.0)
    with pytest.raises(XmTakenError) as second:
        tbuf.Writer("x", SIX)
    assert str(second.value) == (
        "arm:x: the link already has a writer (got process "
        f"{os.getpid()} of arm); end that one first, or give this writer a link of its "
        "own"
    )
    with pytest.raises(XmTakenError, match="already has a reader"):
        tbuf.Reader("arm:x")
    link[0].close()
    with tbuf.Writer("x", SIX) as successor:
        successor.write()
        assert link[1].read(), "the successor goes on in the same buffer"


def test_a_successor_goes_on_counting(link):
    writer, reader = link
    for _ in range(3):
        writer.write()
    reader.read()
    writer.close()
    with tbuf.Writer("x", SIX) as second:
        second.write()
        assert reader.read()
    assert (reader.number, reader.lost, reader.restarts) == (4, 0, 0)


def test_a_new_reader_gets_what_stands(link):
    writer, reader = link
    writer.value[:] = 3
    writer.write()
    assert reader.read()
    reader.close()
    with tbuf.Reader("arm:x") as second:
        assert second.read(), "although the former one had read it"
        assert second.value.tolist() == [3.0] * 6
        assert not second.read()
        assert second.lost == 0


@pytest.mark.parametrize(
    ("end", "name"),
    [
        (tbuf.Writer, "vision:x"),
        (tbuf.Writer, "a:b:c"),
        (tbuf.Reader, "x y"),
        (tbuf.Reader, "vision:"),
        (tbuf.Reader, ""),
    ],
)
def test_names(end, name):
    with pytest.raises(XmNameError):
        end(name, SIX)


def test_a_name_that_is_somebody_elses_says_whose():
    with pytest.raises(XmNameError) as refused:
        tbuf.Writer("vision:x", SIX)
    assert str(refused.value) == (
        "vision:x: a link is named after its writer (expected arm or arm0:x, got "
        "vision:x); name it x, or let vision write it"
    )


def test_a_reader_without_a_layout_needs_a_writer():
    with pytest.raises(XmMissingError, match="there is no such link"):
        tbuf.Reader("vision:x")


@pytest.mark.usefixtures("link")
def test_two_layouts_are_refused():
    for end in (tbuf.Reader, tbuf.Writer):
        with pytest.raises(XmLayoutError) as refused:
            end("arm:x", POSE)
        assert "have different records" in str(refused.value)
        assert "('id', '<i4')" in str(refused.value)


@pytest.mark.parametrize("bad", ["O", [("a", "O")], ("V", 0), ("f8", 200_000)])
def test_records_that_cannot_be_sent(bad):
    with pytest.raises(XmLayoutError, match="cannot be sent"):
        tbuf.Writer("bad", bad)


def test_destroy_tells_the_other_end(link):
    writer, reader = link
    writer.destroy()
    with pytest.raises(XmDestroyedError):
        reader.read()
    with pytest.raises(XmError, match="closed"):
        writer.write()


def test_the_last_one_out_removes_the_file(link, shared_memory):
    writer, reader = link
    (path,) = shared_memory.glob("*.tbuf")
    assert path.name == f"pbonet.{os.geteuid()}.d:arm:x.tbuf"
    assert path.stat().st_mode & 0o777 == 0o600
    writer.close()
    assert path.exists()
    reader.close()
    assert not path.exists()


def test_a_wait_ends_with_a_record_or_in_time(link):
    writer, reader = link
    assert not reader.wait(time.monotonic_ns() + 1_000_000)
    thread = threading.Thread(target=lambda: (time.sleep(0.02), writer.write()))
    thread.start()
    assert reader.wait(time.monotonic_ns() + 30 * SECOND)
    thread.join()
    assert reader.read()
    assert not reader.wait(0), "what was read does not count"


CHILD = """
import sys, time
from pbonet import tbuf, xm
xm.live_on("arm0", domain="d", subsystem="arm")
end = tbuf.Writer("x", ("f8", 6)) if sys.argv[1] == "write" else tbuf.Reader("arm:x")
print("ready", flush=True)
while True:
    end.write() if sys.argv[1] == "write" else end.read()
"""


@pytest.mark.parametrize("role", ["write", "read"])
def test_whoever_is_killed_leaves_its_place_and_the_buffer(role):
    mine = tbuf.Reader("arm:x", SIX) if role == "write" else tbuf.Writer("x", SIX)
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, role], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "ready\n"
    if role == "write":
        wait_for(mine.read, "a record")
    child.kill()
    child.wait(10)
    child.stdout.close()
    other = tbuf.Writer("x", SIX) if role == "write" else tbuf.Reader("arm:x")
    writer, reader = (other, mine) if role == "write" else (mine, other)
    reader.read()
    writer.value[:] = -1
    writer.write()
    assert reader.read()
    assert reader.value.tolist() == [-1.0] * 6
    writer.close()
    reader.close()


def damage(path, offset, data):
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(data)


@pytest.mark.parametrize(
    ("offset", "data", "kind", "words"),
    [
        (0, b"x", XmDamagedError, "not a buffer"),
        (8, struct.pack("<I", 99), XmLayoutError, "another version"),
        (16, struct.pack("<Q", 1 << 40), XmDamagedError, "not a buffer"),
        (0, struct.pack(">Q", 0x6662745F74656E62), XmLayoutError, "byte order"),
    ],
)
def test_files_that_are_no_buffer(shared_memory, offset, data, kind, words):
    writer = tbuf.Writer("x", SIX)
    (path,) = shared_memory.glob("*.tbuf")
    damage(path, offset, data)
    with pytest.raises(kind, match=words):
        tbuf.Reader("arm:x")
    writer.close()


def test_sweep_removes_what_nobody_uses(shared_memory):
    with tbuf.Writer("kept", SIX):
        writer = tbuf.Writer("left", SIX)
        writer.unmap()  # as a killed process would
        assert tbuf.sweep("other") == []
        assert tbuf.sweep("d") == ["arm:left"]
        assert len(list(shared_memory.glob("*.tbuf"))) == 1


@pytest.mark.parametrize("dtype", ["f4", SIX, POSE, np.dtype([("a", POSE, (2,))])])
def test_a_layout_is_told_in_text(dtype):
    dtype = np.dtype(dtype)
    assert layout.parse(layout.describe(dtype)) == dtype


@pytest.mark.parametrize(
    "text",
    [
        *(b"", b"('q9', ())", b"1", b"__import__('os')", b"\xff"),
        *(b"(" * 60_000, b"-" * 60_000 + b"1", b"('f8', (1" + b"0" * 30 + b",))"),
    ],
    ids=repr_short,
)
def test_a_text_that_tells_no_layout(text):
    with pytest.raises(XmLayoutError, match="not understood"):
        layout.parse(text)


def test_links_can_be_seen_from_outside(link):
    writer, _ = link
    me = f"process {os.getpid()} of arm"
    (found,) = tbuf.seen("d", places.standing("d"))
    assert (found.name, found.writer, found.reader) == ("arm:x", me, me)
    assert (found.number, found.age) == (0, None)
    writer.write()
    writer.close()
    (found,) = tbuf.seen("d", places.standing("d"))
    assert (found.writer, found.reader, found.number) == ("", me, 1)
    assert 0 <= found.age < 60
    assert tbuf.seen("other", places.standing("other")) == []
