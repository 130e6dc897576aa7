"""Handlers of errors by code, class and scope (Stewart 1994, 8.2), on a bench."""

from __future__ import annotations

from typing import Annotated as A

import pytest

from pbonet import Answer, Handling, OutVar, PortBasedObject, State
from pbonet.errors import DeviceError, MethodError
from pbonet.testing import Bench

HOT, LOST = 7, 8


def bench(cycle, *, init=None, error=Answer.ERROR, name="bench"):
    """Return a bench that is ON with a module of these methods, and its diary."""
    diary = []

    class Probe(PortBasedObject):
        y: A[float, OutVar("Y", "1", "none", "number of whole cycles")]

        def init(self):
            self.diary = diary
            if init:
                init(self)

        def cycle(self, _dt):
            self.y += 1.0
            cycle(self)
            diary.append("end")

        def error(self, found):
            diary.append(f"error: {found}")
            return error

    made = Bench(Probe, name=name)
    made.on()
    return made, diary


def answering(answer, diary):
    def handler(error):
        diary.append(f"handler: {error}")
        return answer

    return handler


# -- scopes ---------------------------------------------------------------------------


@pytest.mark.parametrize("answer", [Handling.CONTINUE, None])
def test_behind_fail_the_next_line_runs(answer):
    def cycle(self):
        with self.task.on_error(HOT, answering(answer, self.diary)) as scope:
            self.task.fail("too hot", HOT)
            self.diary.append("next line")
        assert scope.error.number == HOT

    made, diary = bench(cycle)
    assert made.step() is State.ON
    assert diary == ["handler: bench: too hot", "next line", "end"]
    assert made.outputs.y == 1.0


def test_a_jump_ends_the_scope_and_the_method_goes_on_behind_it():
    def cycle(self):
        with self.task.on_error(HOT, answering(Handling.JUMP, self.diary)) as scope:
            self.task.fail("too hot", HOT)
            self.diary.append("next line")
        self.diary.append(f"behind: {scope.error}")

    made, diary = bench(cycle)
    assert made.step() is State.ON
    assert diary[1:] == ["behind: bench: too hot", "end"]


@pytest.mark.parametrize("answer", [Handling.CONTINUE, Handling.JUMP, None])
def test_an_exception_goes_on_behind_the_scope(answer):
    def cycle(self):
        with self.task.on_error(DeviceError, answering(answer, self.diary)) as scope:
            raise DeviceError("no encoder")
        assert isinstance(scope.error, DeviceError)

    made, diary = bench(cycle)
    assert made.step() is State.ON
    assert diary == ["handler: no encoder", "end"]


def test_without_a_handler_the_scope_is_left():
    def cycle(self):
        with self.task.on_error(None) as scope:
            self.task.fail("anything")
        self.diary.append(type(scope.error).__name__)

    made, diary = bench(cycle)
    made.step()
    assert diary == ["MethodError", "end"]


def test_other_errors_pass_by():
    def cycle(self):
        with self.task.on_error(HOT) as one, self.task.on_error(DeviceError) as two:
            self.task.fail("lost", LOST)
        raise AssertionError([one, two])

    made, diary = bench(cycle)
    with pytest.raises(MethodError, match="lost"):
        made.step()
    assert diary == ["error: bench: lost"]
    assert made.state is State.ERROR


@pytest.mark.parametrize("kind", ["fail", "raise"])
def test_the_innermost_is_asked_first_and_may_hand_it_on(kind):
    def cycle(self):
        outer = answering(Handling.JUMP, self.diary)
        inner = answering(Handling.ABORT, self.diary)
        with self.task.on_error(None, outer) as caught:
            with self.task.on_error(None, inner) as passed:
                if kind == "fail":
                    self.task.fail("x")
                raise RuntimeError("x")
            raise AssertionError
        assert (passed.error, bool(caught.error)) == (None, True)

    made, diary = bench(cycle)
    assert made.step() is State.ON
    assert len(diary) == 3
    assert diary[0] == diary[1]


def test_what_no_handler_puts_right_goes_to_error_once():
    def cycle(self):
        with self.task.on_error(None, answering(Handling.ABORT, self.diary)):
            self.task.fail("x", HOT)

    made, diary = bench(cycle, error=Answer.OFF)
    assert made.step() is State.OFF
    assert diary == ["handler: bench: x", "error: bench: x"]


def test_a_scope_can_be_entered_again_and_ends_with_its_lines():
    def cycle(self):
        scope = self.task.on_error(HOT)
        for number in range(3):
            with scope:
                if number != 1:
                    self.task.fail(f"{number}", HOT)
            self.diary.append(str(scope.error))
        self.task.fail("outside", HOT)

    made, diary = bench(cycle)
    with pytest.raises(MethodError, match="outside"):
        made.step()
    assert diary[:3] == ["bench: 0", "None", "bench: 2"]
    assert made.task.scopes == []


def test_in_init_a_scope_counts_and_nothing_else_does():
    def init(self):
        self.task.always_on_error(None, answering(None, self.diary))
        with self.task.on_error(OSError):
            raise DeviceError("no camera")
        self.task.fail("no light")

    with pytest.raises(MethodError, match=r"bench\.init: no light"):
        bench(None, init=init)


def test_a_handler_that_fails_is_the_error():
    asked = []

    def fails(error):
        asked.append(str(error))
        raise ZeroDivisionError("within the handler")

    def cycle(self):
        with self.task.on_error(None, fails):
            self.task.fail("x")

    made, diary = bench(cycle)
    with pytest.raises(MethodError) as caught:
        made.step()
    assert str(caught.value) == (
        "bench.cycle: ZeroDivisionError: within the handler; this happened in the "
        "handler of: x"
    )
    assert diary == ["error: within the handler"]
    assert asked == ["bench: x"], "it is not asked about its own failure"


def test_an_error_that_a_handler_raises_again_is_noted_once():
    """One exception, raised in each of many cycles, must not grow with them."""
    kept = OSError("the bus is gone")

    def fails(_error):
        raise kept

    def cycle(self):
        with self.task.on_error(None, fails):
            self.task.fail("x")

    made, _ = bench(cycle, error=Answer.CONTINUE)
    for _ in range(3):
        made.step()
    assert kept.__notes__ == ["this happened in the handler of: x"]


def test_a_handler_that_reports_an_error_ends_there():
    def cycle(self):
        def again(_error):
            self.task.fail("again", HOT)

        self.task.always_on_error(HOT, again)
        self.task.fail("x", HOT)

    made, _ = bench(cycle)
    with pytest.raises(MethodError, match="again; this happened in the handler of: x"):
        made.step()
    assert made.state is State.ERROR


class UnspeakableError(Exception):
    """An exception whose text cannot be had."""

    def __str__(self):
        raise LookupError("no words")


def test_an_exception_without_a_text_is_an_error_like_any_other():
    def cycle(self):
        with self.task.on_error(UnspeakableError):
            raise UnspeakableError
        raise UnspeakableError

    made, _ = bench(cycle)
    with pytest.raises(
        MethodError, match=r"^bench\.cycle: UnspeakableError; and then "
    ):
        made.step()
    assert made.state is State.ERROR
    (notice,) = [one for one in made.notices() if one.handled]
    assert notice.text == "UnspeakableError: jump"


def test_of_a_group_all_is_told():
    def cycle(_self):
        raise ExceptionGroup("two", [ValueError("a"), DeviceError("b")])

    made, _ = bench(cycle)
    with pytest.raises(
        MethodError, match=r"exceptions\): ValueError: a, DeviceError: b"
    ):
        made.step()


def test_an_answer_that_there_is_not():
    def cycle(self):
        with self.task.on_error(None, lambda _: "please"):
            self.task.fail("x")

    made, _ = bench(cycle)
    with pytest.raises(MethodError) as caught:
        made.step()
    assert str(caught.value) == (
        "bench.cycle: an error handler returned an invalid answer "
        "(expected None or Handling.ABORT or Handling.CONTINUE or Handling.JUMP, "
        "got 'please'); this happened in the handler of: x"
    )


# -- for the life of the task ---------------------------------------------------------


def kept(code, answer):
    def init(self):
        self.task.always_on_error(code, answering(answer, self.diary))

    return init


def test_kept_handlers_are_asked_when_no_scope_was():
    def cycle(self):
        with self.task.on_error(LOST):
            self.task.fail("hot", HOT)
            self.diary.append("next line")

    made, diary = bench(cycle, init=kept(HOT, Handling.CONTINUE))
    assert made.step() is State.ON
    assert diary == ["handler: bench: hot", "next line", "end"]


def test_without_a_scope_a_jump_goes_to_the_next_cycle():
    def cycle(self):
        if "x" not in self.diary:
            self.diary.append("x")
            self.task.fail("hot", HOT)

    made, diary = bench(cycle, init=kept(HOT, Handling.JUMP))
    assert made.step() is State.ON
    assert made.outputs.y == 0.0  # discarded
    assert made.step() is State.ON
    assert diary == ["x", "handler: bench: hot", "end"]
    assert made.executor.failure is None


@pytest.mark.parametrize("answer", [Handling.CONTINUE, Handling.JUMP])
def test_an_exception_without_a_scope_discards_the_cycle(answer):
    def cycle(_self):
        if made.task.cyclecount == 0:
            raise DeviceError("no encoder")

    made, diary = bench(cycle, init=kept(OSError, answer))
    assert made.step(n=2) is State.ON
    assert diary == ["handler: no encoder", "end"]
    assert made.executor.failure is None


def test_the_latest_is_asked_first_and_error_last():
    def init(self):
        self.task.always_on_error(None, answering(Handling.ABORT, self.diary))
        self.task.always_on_error(HOT, answering(Handling.ABORT, self.diary))

    made, diary = bench(lambda self: self.task.fail("x", HOT), init=init)
    with pytest.raises(MethodError):
        made.step()
    assert diary == [*["handler: bench: x"] * 2, "error: bench: x"]


# -- what is told ---------------------------------------------------------------------


def test_what_was_put_right_is_told_with_number_cycle_and_place():
    def cycle(self):
        with self.task.on_error(HOT):
            self.task.fail("hot", HOT)
        with self.task.on_error(OSError):
            raise DeviceError("no encoder")

    made, _ = bench(cycle)
    made.step()
    made.step()
    first, second, third, _ = made.notices()
    assert (first.handled, first.text, first.code) == (True, "hot: jump", HOT)
    assert (second.text, second.code) == ("DeviceError: no encoder: jump", 1)
    assert [first.cycle, third.cycle] == [0, 1]
    for notice, line in ((first, 3), (second, 5)):
        number = cycle.__code__.co_firstlineno + line - 1
        assert notice.place == f"{__file__}:{number} in cycle"
    assert (made.task.errmsg, made.task.errnum) == ("DeviceError: no encoder", 1)


def test_an_error_knows_its_number_and_its_line():
    def cycle(self):
        self.task.fail("hot", HOT)

    made, _ = bench(cycle)
    with pytest.raises(MethodError) as caught:
        made.step()
    number = cycle.__code__.co_firstlineno + 1
    assert (caught.value.number, caught.value.place) == (
        *(HOT, f"{__file__}:{number} in cycle"),
    )
