"""What is heard from outside is kept on a tape, and given again without being asked."""

from __future__ import annotations

import os
import pathlib
import socket
import sys

import numpy as np
import pytest

from pbonet import tbuf, xm
from pbonet.errors import DeviceError, XmDestroyedError, XmQueueFullError
from pbonet.log import TaskAbout
from pbonet.outside import (
    BrokenOffError,
    NotRecordedError,
    Outside,
    Player,
    Tape,
    refuse,
    using,
)
from pbonet.testing import _outside
from pbonet.testing._chance import Chance
from pbonet.xm.ipc import mailboxes, names

ABOUT = TaskAbout(
    domain="d",
    rtpu="arm0",
    subsystem="arm",
    task="t",
    module="m",
    pid=1,
    freq=1.0,
    rmod="",
    rmod_name="",
)


@pytest.fixture(autouse=True)
def at_home():
    with names.living_on("arm0", domain="d", subsystem="arm"):
        yield


def recorded(program, tape=None):
    """Run a program while a tape is in use; return what it returned, and the tape's."""
    tape = tape or Tape()
    with using(tape):
        found = program()
    return found, tape.take()


def played(program, heard):
    """Run it again on what was heard."""
    player = Player()
    player.lost = player.feed(heard)
    with _outside.only(player, ABOUT, Chance()):
        return program()


def never():
    pytest.fail("it was asked in a replay")


@pytest.mark.parametrize(
    "answer",
    [
        *(None, True, -7, 1 << 63, 2.5, "text", b"bytes", (1, 2.0), [1, [2]]),
        *((b"x", ("a", 1)), [(1,), [(2, ((),))]], {"a": None, (1, (2,)): [(b"", 3)]}),
    ],
)
def test_an_answer_comes_back_as_it_was(answer) -> None:
    found, heard = recorded(lambda: Outside("it").ask(lambda: answer))
    assert found is answer
    again = played(lambda: Outside("it").ask(never), heard)
    assert (again, type(again)) == (answer, type(answer))


def test_floats_come_back_to_the_bit() -> None:
    odd = [float("nan"), -0.0, 5e-324, float("inf")]
    _, heard = recorded(lambda: Outside("it").ask(lambda: odd))
    again = played(lambda: Outside("it").ask(never), heard)
    assert np.array(again).tobytes() == np.array(odd).tobytes()


def test_an_answer_that_is_nothing_new_leaves_no_record() -> None:
    _, first = recorded(lambda: Outside("it"))
    tape = Tape()
    answers = iter([b"", b"", b"x", b"", b"y"])
    with using(tape):
        outside = Outside("it")
        for _ in range(5):
            outside.ask(lambda: next(answers), default=b"")
    heard = tape.take()
    assert len(heard) == len(first) + 2 * 24, "of the third and the fifth call"

    def again():
        outside = Outside("it")
        return [outside.ask(never, default=b"") for _ in range(5)]

    assert played(again, heard) == [b"", b"", b"x", b"", b"y"]


@pytest.mark.parametrize(
    "error",
    [
        DeviceError("it is gone", where="/dev/x", got="nothing", remedy="look"),
        BlockingIOError(11, "try again"),
        ValueError("what"),
        KeyError("which"),
    ],
)
def test_an_exception_is_raised_again(error) -> None:
    def fail():
        raise error

    def program(call):
        with pytest.raises(type(error)) as caught:
            Outside("it").ask(call)
        return caught.value

    _, heard = recorded(lambda: program(fail))
    again = played(lambda: program(never), heard)
    assert type(again) is type(error)
    assert again.args == error.args


def test_an_exception_of_ones_own_cannot_be_made_again() -> None:
    class OwnError(Exception):
        pass

    def fail():
        raise OwnError("mine")

    tape = Tape()
    with using(tape), pytest.raises(OwnError):
        Outside("it").ask(fail)
    with pytest.raises(NotRecordedError, match="it raised OwnError: mine"):
        played(lambda: Outside("it").ask(never), tape.take())


def test_a_wait_that_was_broken_off_is_broken_off_again() -> None:
    def fail():
        raise KeyboardInterrupt

    tape = Tape()
    with using(tape), pytest.raises(KeyboardInterrupt):
        Outside("it").ask(fail)
    with pytest.raises(BrokenOffError):
        played(lambda: Outside("it").ask(never), tape.take())


@pytest.mark.parametrize(
    "answer", [object(), bytearray(b"x"), np.zeros(2), {1, 2}, np.float64(1.0)]
)
def test_what_cannot_be_recorded_is_refused_where_it_is_asked(answer) -> None:
    for whole, within in (
        (answer, ""),
        ([1, answer], " within a list"),
        (({"a": answer},), " within a tuple"),
    ):
        with (
            using(Tape()),
            pytest.raises(DeviceError, match="cannot be recorded") as caught,
        ):
            Outside("a scale").ask(lambda whole=whole: whole)
        assert caught.value.where == "a scale"
        assert caught.value.got == f"{type(answer).__name__}{within}"


def test_a_key_that_would_change_is_refused() -> None:
    with using(Tape()), pytest.raises(DeviceError, match="got Policy within a dict"):
        Outside("it").ask(lambda: {(1, xm.Policy.HPF): 1})


@pytest.mark.parametrize("raises", [False, True])
def test_a_handler_amid_a_call_may_ask_the_same_source(raises) -> None:
    """A replay runs it before the line that it interrupted: it has the first number."""

    def program(*, handled: bool) -> list[object]:
        line = Outside("line")
        found: list[object] = []

        def handler() -> None:
            found.append(line.ask(lambda: b"of the handler"))

        def call() -> bytes:
            handler()
            if raises:
                raise OSError(5, "unplugged")
            return b"of the cycle"

        if handled:
            handler()
        try:
            found.append(line.ask(call))
        except OSError as error:
            found.append(error.errno)
        return [*found, line.ask(lambda: b"the next")]

    found, heard = recorded(lambda: program(handled=False))
    assert found == [b"of the handler", 5 if raises else b"of the cycle", b"the next"]
    assert played(lambda: program(handled=True), heard) == found


def test_without_a_tape_all_is_asked() -> None:
    thing = object()
    assert Outside("it").ask(lambda: thing) is thing


def test_sources_are_told_apart_and_must_be_the_same() -> None:
    def program(a="a", b="b"):
        first, second = Outside(a), Outside(b)
        return [one.ask(lambda one=one: one.name) for one in (second, first, second)]

    found, heard = recorded(program)
    assert found == played(program, heard) == ["b", "a", "b"]
    with pytest.raises(NotRecordedError, match="it opens c, but the log has a"):
        played(lambda: program("c"), heard)
    with pytest.raises(
        NotRecordedError, match="it opens c, but the log has nothing more"
    ):
        played(lambda: [program(), Outside("c")], heard)


def test_more_questions_than_were_asked_have_no_answer() -> None:
    _, heard = recorded(lambda: Outside("it").ask(int))

    def twice():
        outside = Outside("it")
        return outside.ask(never), outside.ask(never)

    with pytest.raises(NotRecordedError, match="its input from it is not recorded"):
        played(twice, heard)


def test_what_finds_no_room_is_said() -> None:
    def program():
        outside = Outside("it")
        return [outside.ask(lambda: bytes(600), default=b"") for _ in range(3)]

    _, heard = recorded(program, Tape(1000))
    assert len(heard) <= 1000
    with pytest.raises(
        NotRecordedError, match="its input from it did not fit on the tape"
    ):
        played(program, heard)


def test_room_for_a_long_answer_is_asked_for_in_advance() -> None:
    def program():
        return Outside("it", room=4096).ask(lambda: bytes(4096))

    with pytest.raises(NotRecordedError):
        played(lambda: Outside("it").ask(never), recorded(program, Tape(16))[1])
    assert played(program, recorded(program, Tape(1000))[1]) == bytes(4096)


def test_a_link_is_read_again_without_a_buffer() -> None:
    def program(write):
        with (
            tbuf.Writer("pose", ("f8", 3)) as writer,
            tbuf.Reader("arm:pose", (">f8", 3)) as reader,
        ):
            seen = []
            for n in range(6):
                if write and n % 2 == 0:
                    for _ in range(n):
                        writer.value[:] = n
                        writer.write()
                new = reader.read()
                stamps = reader.number, reader.time_ns, reader.stamp_ns, reader.lost
                seen.append((new, reader.value.tolist(), *stamps, reader.age_ns()))
                seen.append((reader.written, reader.last_ns, reader.destroyed))
            return seen

    found, heard = recorded(lambda: program(write=True))
    assert sum(one[0] for one in found[::2]) == 2
    assert played(lambda: program(write=False), heard) == found


def test_that_a_link_was_destroyed_is_felt_again() -> None:
    def program():
        reader = tbuf.Reader("arm:pose", ("f8", 3))
        reader.destroy()
        with pytest.raises(XmDestroyedError):
            reader.read()
        reader.close()
        return True

    def recorded_program():
        reader = tbuf.Reader("arm:pose", ("f8", 3))
        with using(None):
            tbuf.Writer("pose", ("f8", 3)).destroy()
        with pytest.raises(XmDestroyedError):
            reader.read()
        reader.close()
        return True

    assert recorded(recorded_program)[0]
    assert played(program, recorded(recorded_program)[1])


def test_queues_and_semaphores_answer_again() -> None:
    def program(send):
        queue = xm.queue("q", policy=xm.Policy.HPF, messages=2)
        count = xm.Semaphore.create("s", initial=1, maximum=3)
        seen = [queue.policy, queue.messages, count.maximum, count.binary]
        for n in range(3):
            try:
                queue.send(send(n), n)
            except XmQueueFullError as error:
                seen.append(str(error))
        buffer = bytearray(8)
        seen += [len(queue), queue.free, queue.wait(0), queue.receive_into(buffer)]
        seen += [bytes(buffer), queue.last_priority, queue.try_receive()]
        seen += [queue.try_receive(), count.value, count.try_p(), count.try_p()]
        seen += [count.v(), count.p(1), queue.name, queue.path, count.waiting]
        for one in (queue, count):
            one.destroy()
        return seen

    found, heard = recorded(lambda: program(lambda n: b"abc"[: n + 1]))
    again = played(lambda: program(lambda n: b"abc"[: n + 1]), heard)
    assert again == found
    assert [type(one) for one in again] == [type(one) for one in found]


def test_mailboxes_work_on_what_was_heard() -> None:
    def program():
        got = []
        with xm.Mailbox("door", got.append, depth=4) as box:
            xm.interrupt("door", 7)
            xm.interrupt("door", -1)
            served = box.serve(), box.pending, box.sent
        return got, served

    try:
        found, heard = recorded(program)
        assert found == ([7, -1], (2, 0, 2))
        assert played(program, heard) == found
    finally:
        mailboxes.forget()
        xm.sweep("arm0", "d")


@pytest.mark.parametrize(
    ("program", "what"),
    [
        (lambda: xm.segment("map", 64), "the shared memory segment map"),
        (lambda: xm.Segment.attach("map"), "the shared memory segment map"),
        (socket.socket, "a socket"),
        (pathlib.Path("/dev/mem").read_bytes, "the device /dev/mem"),
        (lambda: os.open(b"/dev/mem", os.O_RDONLY), "the device .*/dev/mem"),
        (lambda: sys.audit("open", pathlib.Path("/dev/mem")), "the device /dev/mem"),
        (lambda: refuse("a thing"), "a thing"),
    ],
)
def test_what_no_log_can_have_is_refused(program, what) -> None:
    with pytest.raises(NotRecordedError, match=f"{what}.* results are in no log"):
        played(program, b"")


def test_files_may_be_read_and_the_guard_ends_with_the_block(tmp_path) -> None:
    (tmp_path / "table").write_text("1 2 3")
    text = played((tmp_path / "table").read_text, b"")
    assert text == "1 2 3"
    socket.socket().close()
